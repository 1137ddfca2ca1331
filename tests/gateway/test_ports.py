# SPDX-License-Identifier: MIT
"""Topics that viewers subscribe to: few, and those of open maps first."""

from tsfusion.gateway.ports import Subscriptions


def test_only_what_can_be_a_maps_topic_is_remembered() -> None:
    topics = Subscriptions()
    for good in (b"", b"me", b"mesh/", b"mesh/y", b"mesh/yard", b"mesh/yard/", b"mesh/attic/"):
        assert topics.add(good, ["yard"])
    for bad in (b"x", b"mesh/Yard", b"mesh/yard/x", b"mesh//", b"mesh/" + b"a" * 33, b"mesh/\n", b"mesh/a\n"):
        assert not topics.add(bad, ["yard"])
    assert len(topics) == 7


def test_topics_are_few_and_those_of_open_maps_have_room() -> None:
    topics = Subscriptions()
    taken = [topics.add(f"mesh/map{i}/".encode(), ["yard"]) for i in range(1000)]
    assert taken.count(True) == len(topics) == 256
    assert not topics.watched("yard")
    assert topics.add(b"mesh/yard/", ["yard"])
    assert topics.watched("yard")
    topics.discard(b"mesh/yard/")
    assert not topics.watched("yard")
    assert topics.watched("map1")
