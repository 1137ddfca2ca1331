# SPDX-License-Identifier: MIT
"""`tsfusion status`."""

import time
from typing import TYPE_CHECKING, Annotated

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from tsfusion.transport import Status


def status(
    connect: options.Connect = None,
    control: options.Control = None,
    watch: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=0.1, help="Ask again and again.")
    ] = None,
    timeout: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.1, help="Wait so long for an answer.")
    ] = 5.0,
    json: options.Json = False,
) -> None:
    """Ask a running server how it is; status 1 when it does not answer."""
    from tsfusion.cli import show
    from tsfusion.client import fetch_status
    from tsfusion.config import ClientConfig

    address = connect or ClientConfig().address
    while True:
        answer = fetch_status(address, control=control, timeout=timeout)
        if not json:
            typer.echo(describe(answer))
        elif watch is None:
            show.as_json(answer)
        else:
            show.as_json_line(answer)
        if watch is None:
            return
        time.sleep(watch)


def describe(answer: "Status") -> str:
    """A server's status in a few lines."""
    from tsfusion.cli.show import grouped, size

    delay = answer.delay_ms
    waiting = answer.keyframes_durable - answer.keyframes_fused - sum(answer.keyframes_rejected.values())
    lines = [
        f"fuser      {answer.fuser}, up {answer.uptime_s:.0f} s, {answer.fuser_restarts} restarts",
        f"keyframes  {answer.keyframes_durable} durable, {answer.keyframes_fused} fused, {waiting} waiting, "
        f"{answer.sessions} sessions",
        f"delay      mean {delay.mean:.0f} ms, p95 {delay.p95:.0f}, max {delay.max:.0f} (last {delay.count})",
        f"map        {grouped(answer.blocks)} blocks, {size(answer.map_bytes)}, hash {answer.map_hash}",
        f"journal    {size(answer.journal_bytes)} in {answer.state}",
        "memory     " + ", ".join(f"{name} {size(peak)}" for name, peak in answer.peak_rss_bytes.items()),
    ]
    for title, reasons in (("rejected", answer.keyframes_rejected), ("refused", answer.messages_refused)):
        if reasons:
            lines.append(
                f"{title:<10} " + "; ".join(f"{count} × {reason}" for reason, count in reasons.items())
            )
    return "\n".join(lines)
