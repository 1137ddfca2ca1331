# SPDX-License-Identifier: MIT
"""Maps belong to one thread of one process: another is told so, at once and in one line."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from command_processes import environment, python
from formula_scenes import sphere_views, volume_of

from tsfusion import Volume
from tsfusion.core.errors import MapError
from tsfusion.datasets.worlds.synthetic import Synthetic

VIEWS = sphere_views(0.4, 4)
USES: list[Callable[[Volume], object]] = [
    lambda volume: volume.integrate(VIEWS[1]),
    lambda volume: volume.retract(VIEWS[0]),
    lambda volume: volume.merge(volume_of(VIEWS[1:])),
    Volume.map_hash,
    Volume.extract_mesh,
    Volume.copy,
    Volume.stats,
    lambda volume: volume.save("never.tsf"),
    lambda volume: volume.sample(np.zeros((1, 3), np.float32)),
    lambda volume: Volume(0.05),
    lambda volume: Synthetic(count=1)[0],
]


@pytest.mark.parametrize("use", USES)
def test_another_thread_is_refused_and_changes_nothing(use: Callable[[Volume], object]) -> None:
    volume = volume_of(VIEWS[:2])
    before = volume.map_hash()
    with ThreadPoolExecutor(1) as pool, pytest.raises(MapError, match="belong to the first thread"):
        pool.submit(use, volume).result()
    assert volume.map_hash() == before


def test_a_slice_that_follows_the_map_is_of_the_same_thread() -> None:
    volume = volume_of(VIEWS[:2])
    current = volume.current_slice(0.0, 0.1, up="z")
    with ThreadPoolExecutor(1) as pool, pytest.raises(MapError, match="belong to the first thread"):
        pool.submit(current.update).result()


def test_threads_at_once_never_make_another_map() -> None:
    volume = volume_of(VIEWS[:1])
    before, refused = volume.map_hash(), []

    def work(first: int) -> None:
        for keyframe in VIEWS[first::2]:
            try:
                volume.integrate(keyframe)
            except MapError as error:
                refused.append(error)

    threads = [threading.Thread(target=work, args=(first,)) for first in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(refused) == len(VIEWS)
    assert volume.map_hash() == before


FORKS = """
import os, sys
from tsfusion import MapError
from formula_scenes import sphere_views, volume_of
views = sphere_views(0.4, 2)
volume = volume_of(views[:1])
for use in (lambda: volume.integrate(views[1]), volume.extract_mesh, lambda: volume_of(views)):
    child = os.fork()
    if not child:
        try:
            use()
        except MapError as error:
            print(error, flush=True)
        sys.exit(7)
    assert os.WEXITSTATUS(os.waitpid(child, 0)[1]) == 7
volume.integrate(views[1])
print(volume.map_hash())
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_forked_process_refuses_at_once_and_its_parent_goes_on() -> None:
    done = python(FORKS, env=environment())
    *refused, found = done.stdout.splitlines()
    assert len(refused) == 3, done.stderr
    assert all("forked" in line and "spawn" in line for line in refused)
    assert found == volume_of(sphere_views(0.4, 2)).map_hash()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_fork_before_the_first_map_and_a_worker_thread_may_have_maps() -> None:
    script = (
        "import os, tsfusion.tsdf.volume\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from formula_scenes import sphere_views, volume_of\n"
        "child = os.fork()\n"
        "made = lambda: volume_of(sphere_views(0.4, 4)).map_hash()\n"
        "print(made() if child else ThreadPoolExecutor(1).submit(made).result(), flush=True)\n"
        "if child: os.waitpid(child, 0)\n"
    )
    done = python(script, env=environment())
    assert done.stdout.split() == 2 * [volume_of(VIEWS).map_hash()], done.stderr
