# SPDX-License-Identifier: MIT
"""`tsfusion ros2 topics`: list what a running ROS 2 system publishes."""

import time
from typing import Annotated

import typer

from tsfusion.cli import options, verbs

app = typer.Typer(cls=verbs.Group, help="Look at a running ROS 2 system, over DDS or Zenoh, without ROS.")

TransportFlag = Annotated[
    str | None, typer.Option(metavar="NAME", help="dds or zenoh; default: what is installed.")
]
DomainFlag = Annotated[
    int | None, typer.Option(metavar="NUMBER", help="ROS domain; default ROS_DOMAIN_ID, or 0.")
]
RouterFlag = Annotated[
    str | None, typer.Option(metavar="ENDPOINT", help="Zenoh's router; default tcp/localhost:7447.")
]


@verbs.verb(app, "tsfusion ros2 topics", "tsfusion ros2 topics --transport zenoh --router tcp/robot:7447")
def topics(
    *,
    transport: TransportFlag = None,
    domain: DomainFlag = None,
    router: RouterFlag = None,
    seconds: Annotated[float, typer.Option(metavar="SECONDS", min=0.1, help="How long to listen.")] = 3.0,
    json: options.Json = False,
) -> None:
    """List the topics of a running ROS 2 system: name, type, transport, publishers.

    `tsfusion scan ros2` finds the topics of a depth camera, a stereo pair or a LiDAR among them by itself.
    """
    from tsfusion.cli import output
    from tsfusion.datasets.ros2.live_messages import open_middlewares
    from tsfusion.datasets.ros2.middleware import domain_id

    opened = open_middlewares(lambda _: None, transport=transport, domain=domain, router=router)
    try:
        time.sleep(seconds)
        found = [topic for middleware in opened for topic in middleware.topics()]
    finally:
        for middleware in opened:
            middleware.close()
    if json:
        output.as_json([topic._asdict() for topic in found])
        return
    names = " and ".join(middleware.name for middleware in opened)
    if not found:
        where = "ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE, and for Zenoh a router"
        typer.echo(f"nobody publishes in domain {domain_id(domain)} over {names}; check {where}", err=True)
    width = max((len(topic.name) for topic in found), default=0)
    for topic in found:
        quality = f"{'reliable' if topic.reliable else 'best effort'}{', latched' * topic.latched}"
        typer.echo(f"{topic.name:{width}}  {topic.kind}  {topic.transport}  {topic.publishers}  {quality}")
