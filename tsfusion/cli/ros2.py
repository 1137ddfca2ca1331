# SPDX-License-Identifier: MIT
"""`tsfusion ros2 topics|publish`: list what a running ROS 2 system publishes, and show it a map."""

import math
import time
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Event
from typing import Annotated

import typer

from tsfusion.cli import options, verbs

app = typer.Typer(cls=verbs.Group, help="Talk to a running ROS 2 system over DDS or Zenoh, without ROS.")

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


@verbs.verb(
    app, "tsfusion ros2 publish tcp://server:5555 --map yard", "tsfusion ros2 publish --slice 0.1 1.8 --up z"
)
def publish(
    server: Annotated[
        str | None, typer.Argument(metavar="[ADDRESS]", help="tcp://HOST:PORT of the server.")
    ] = None,
    *,
    transport: TransportFlag = None,
    domain: DomainFlag = None,
    router: RouterFlag = None,
    slice_: Annotated[
        tuple[float, float] | None,
        typer.Option("--slice", metavar="LOW HIGH", help="Costmap of obstacles between two heights, metres."),
    ] = None,
    up: Annotated[str, typer.Option(metavar="AXIS", help="Which way is up, for --slice: z, -y, …")] = "z",
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder that the service save_map writes to.")
    ] = Path("out/ros2"),
    forget: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.1, help="Time that the service forget takes out.")
    ] = 30.0,
    map_: options.Map = None,
    control: options.Control = None,
    key: options.KeyFlag = None,
    server_key: options.ServerKey = None,
    help_all: verbs.HelpAll = None,
) -> int:
    """Show a live map to ROS 2: poses, tf, paths, mesh, points, costmap, distances, diagnostics.

    Runs until Ctrl-C. Services (std_srvs/Trigger): /tsfusion/save_map, /tsfusion/forget, /tsfusion/status.
    """
    from tsfusion.cli import progress
    from tsfusion.core.config import DEFAULT_MAP, ClientConfig
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.datasets.ros2.live_messages import open_middlewares
    from tsfusion.pipelines.shown.ros2_view import Ros2View, RosTopics, SliceHeights
    from tsfusion.wire.asking.map_client import MapClient
    from tsfusion.wire.asking.map_watcher import MapWatcher
    from tsfusion.wire.sockets.curve import client_keys

    options.up_direction(up)
    heights = None if slice_ is None else SliceHeights(*slice_, up)
    if heights is not None and not -math.inf < heights.low < heights.high < math.inf:
        raise InvalidConfig(f"--slice {heights.low:g} {heights.high:g}: expected a height and a greater one")
    address, name, keys = server or ClientConfig().address, map_ or DEFAULT_MAP, client_keys(key, server_key)
    stop = Event()
    with ExitStack() as stack:
        opened = open_middlewares(lambda _: None, transport=transport, domain=domain, router=router)
        for middleware in opened:
            stack.callback(middleware.close)
        feed = stack.enter_context(closing(MapWatcher(address, name, control=control, keys=keys)))
        client = stack.enter_context(MapClient(address, name, control=control, keys=keys))
        view = Ros2View(
            RosTopics(opened), feed, client, heights=heights, out=out, forget_s=forget,
            ask={"control": control, "keys": keys},
        )  # fmt: skip
        typer.echo(
            f"publishes {feed.title} over {' and '.join(one.name for one in opened)}; ends with Ctrl-C"
        )
        with progress.ended_by_signals(stop.set):
            view.run(stop)
    return 0
