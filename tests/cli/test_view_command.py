# SPDX-License-Identifier: MIT
"""`tsfusion view`, and `--view` of a server, as users run them: processes, signals and browsers' requests."""

import json
import os
import signal
import subprocess
import sys
import threading
from http import HTTPStatus
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from command_processes import alive, descendants, eventually, read_until, tsfusion
from foxglove_client import FoxgloveClient
from idle_fuser import COMMAND as IDLE_FUSER
from live_pages import DEADLINE, address_of, ended, running, viewing

from tsfusion.cli import verbs
from tsfusion.cli import view as view_command
from tsfusion.core.errors import InvalidConfig
from tsfusion.pipelines.runs import viewer_child
from tsfusion.pipelines.runs.viewer_child import ViewerChild
from tsfusion.viewer.live_page import LivePage
from tsfusion.viewer.page.page_guard import listen
from tsfusion.wire.asking.queries import fetch_health
from tsfusion.wire.keys import key_folder

NOBODY = "tcp://127.0.0.1:9"
_SERVE = f"""
import sys
from tsfusion.gateway.ports import fuser_process
fuser_process.COMMAND = {IDLE_FUSER!r}
from tsfusion.__main__ import main
main()
"""


def status_of(url: str, **headers: str) -> int:
    try:
        with urlopen(Request(url, headers=headers), timeout=DEADLINE) as answer:
            answer.read()
            return int(answer.status)
    except HTTPError as error:
        return error.code


def test_a_page_is_announced_and_ends_by_ctrl_c() -> None:
    with viewing(NOBODY, "--listen", "127.0.0.1:0") as process:
        url = address_of(process)
        assert status_of(url) == HTTPStatus.OK
        assert status_of(url, Host="evil.example") == HTTPStatus.FORBIDDEN
        place = url.removeprefix("http://")
        second = tsfusion("view", NOBODY, "--listen", place, "--no-browser")
        assert (second.returncode, second.stdout) == (1, "")
        assert f"tsfusion: cannot show a map at {place}: Address already in use; choose" in second.stderr
        status, seconds, said, errors = ended(process, signal.SIGINT)
    assert (status, said) == (0, "")
    assert len(errors.splitlines()) == 1, errors  # of the foreign host
    assert seconds < 10  # 2 on an idle machine


def test_a_token_from_the_environment(tmp_path: Path) -> None:
    with viewing("127.0.0.1:9", "--listen", "127.0.0.1:0", "--json", TSFUSION_TOKEN="open-sesame") as process:
        line = json.loads(read_until(process, "url", DEADLINE))
        assert set(line) == {"url", "shows"}
        assert line["url"].endswith("/?token=open-sesame")
        assert status_of(line["url"]) == HTTPStatus.OK
        assert status_of(line["url"].replace("sesame", "barley")) == HTTPStatus.FORBIDDEN
        status, _, said, errors = ended(process, signal.SIGTERM)
    assert (status, said) == (0, "")
    assert "open-" not in errors
    assert "(token)" in errors


def test_a_browser_is_opened_where_there_is_a_screen(tmp_path: Path) -> None:
    opened, program = tmp_path / "opened", tmp_path / "browser"
    program.write_text(f'#!/bin/sh\necho noise\necho "$1" > {opened}.part\nmv {opened}.part {opened}\n')
    program.chmod(0o700)
    screen = {"DISPLAY": ":77", "BROWSER": f"{program} %s"}
    with viewing(NOBODY, "--listen", "0.0.0.0:0", **screen) as process:
        url = address_of(process)
        assert "/?token=" in url
        assert eventually(opened.exists, DEADLINE)
        assert opened.read_text().strip() == url
        assert ended(process, signal.SIGINT)[::2] == (0, "")
    opened.unlink()
    with viewing(NOBODY, "--listen", "127.0.0.1:0", "--no-browser", **screen) as process:
        address_of(process)
        assert ended(process, signal.SIGINT)[0] == 0
    assert not opened.exists()


def test_what_is_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tsfusion.core.config.ClientConfig.address", NOBODY, raising=False)
    monkeypatch.setattr(view_command, "_ANSWER_SECONDS", 0.1)
    with pytest.raises(InvalidConfig, match=r"no server answers at .*, and there is no out/latest"):
        view_command._target(None, None)
    (tmp_path / "out/latest").mkdir(parents=True)
    assert view_command._target(None, None) == Path("out/latest")
    assert view_command._target("tcp://server:5555", None) == "tcp://server:5555"
    assert view_command._target("server:5555", None) == "tcp://server:5555"
    (tmp_path / "server:5555").mkdir()
    assert view_command._target("server:5555", None) == Path("server:5555")
    for wrong in ("nowhere.tsf", "http://server:80", "server", "tcp://server"):
        with pytest.raises(InvalidConfig):
            view_command._target(wrong, None)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("--view", "--view=127.0.0.1:5558"),
        ("--view recording", "--view=127.0.0.1:5558 recording"),
        ("--view camera:0", "--view=127.0.0.1:5558 camera:0"),
        ("--view --json", "--view=127.0.0.1:5558 --json"),
        ("--view 127.0.0.1:80 x", "--view=127.0.0.1:80 x"),
        ("--view localhost:80", "--view=localhost:80"),
        ("--view [::1]:80", "--view=[::1]:80"),
        ("--view *:80", "--view=*:80"),
        ("--view=host:80 --view", "--view=host:80 --view=127.0.0.1:5558"),
        ("x --out y", "x --out y"),
    ],
)
def test_the_place_of_a_page_may_be_left_out(typed: str, meant: str) -> None:
    assert verbs._with_places(typed.split(), "--view", *verbs._PLACES["--view"]) == meant.split()


def serve(state: Path, *flags: object) -> Any:
    """A server that fuses nothing, with a page."""
    listen = ("--listen", "tcp://127.0.0.1:0", "--state", state, "--view=127.0.0.1:0", "--json")
    return running(sys.executable, "-c", _SERVE, "serve", *listen, *flags)


def page_of(server: "subprocess.Popen[str]") -> int:
    """Number of the process that shows the page."""
    words = {pid: Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0") for pid in descendants(server.pid)}
    (found,) = (pid for pid, line in words.items() if b"view" in line)
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_page_of_a_server_breaks_nothing_and_ends_with_it(tmp_path: Path) -> None:
    with serve(tmp_path / "state") as process:
        ready = json.loads(read_until(process, '"ready"', DEADLINE))
        url = json.loads(read_until(process, '"page"', DEADLINE))["page"]
        assert status_of(url) == HTTPStatus.OK
        child = page_of(process)
        assert os.getpriority(os.PRIO_PROCESS, child) == min(os.getpriority(os.PRIO_PROCESS, 0) + 10, 19)
        os.kill(child, signal.SIGKILL)
        assert eventually(lambda: not alive(child))
        assert fetch_health(ready["listen"], timeout=DEADLINE).maps
        status, _, _, errors = ended(process, signal.SIGTERM)
    assert status == 0
    (warning,) = (line for line in errors.splitlines() if "page" in line)
    assert warning == "tsfusion: WARNING: the page has ended with status -9; everything else goes on"


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_page_ends_with_its_server(tmp_path: Path, number: int) -> None:
    key_folder.create_pair(tmp_path / "keys", "server")
    with serve(tmp_path / "state", "--keys", tmp_path / "keys") as process:
        url = json.loads(read_until(process, '"page"', DEADLINE))["page"]
        assert status_of(url) == HTTPStatus.OK
        child = page_of(process)
        secrets = Path(f"/proc/{child}/cmdline").read_bytes() + Path(f"/proc/{child}/environ").read_bytes()
        assert b"secret" not in secrets
        errors = ended(process, number)[3]
        assert eventually(lambda: not alive(child), DEADLINE)
        assert "page" not in errors
    assert sorted(path.name for path in (tmp_path / "keys").iterdir()) == [
        "allowed.toml",
        "server.key",
        "server.key_secret",
    ]


def test_a_server_with_keys_has_a_page_and_foxglove_at_once(tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="pip install '.[foxglove]'")
    key_folder.create_pair(tmp_path / "keys", "server")
    with serve(tmp_path / "state", "--keys", tmp_path / "keys", "--foxglove=127.0.0.1:0") as process:
        lines = [json.loads(read_until(process, word, DEADLINE)) for word in ('{"', '{"', '{"')]
        urls = {name: url for line in lines for name, url in line.items()}
        assert status_of(urls["page"]) == HTTPStatus.OK
        with FoxgloveClient(urls["foxglove"]) as client:
            client.until(
                lambda: client.last.get("/state", {}).get("state") in ("starting", "ready, no input")
            )
        status, _, _, errors = ended(process, signal.SIGTERM)
    assert (status, "foxglove" in errors.lower()) == (0, False)


def test_a_page_that_cannot_be_shown_is_an_error_before_the_run(tmp_path: Path) -> None:
    with viewing(NOBODY, "--listen", "127.0.0.1:0") as process:
        place = address_of(process).removeprefix("http://")
        for verb in (["serve", "--state", tmp_path / "state"], ["demo"], ["replay", "synthetic:room"]):
            done = tsfusion(*verb, f"--view={place}", cwd=tmp_path)
            assert (done.returncode, done.stdout) == (1, "")
            assert done.stderr.splitlines()[-1].startswith(f"tsfusion: cannot show a map at {place}: Address")
    assert not (tmp_path / "out").exists()


def test_a_page_that_does_not_start_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    told: list[str] = []
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
    viewer = ViewerChild(f"127.0.0.1:{port}", told.append)
    with listen("127.0.0.1", port):  # after it was found free
        viewer.start(NOBODY)
        viewer._reader.join(DEADLINE)
        viewer.close()
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith(f"the page has ended with status 1: cannot show a map at 127.0.0.1:{port}: ")
    assert line.endswith("; everything else goes on")
    assert not told


def test_a_run_s_page_is_told_what_shows_the_map_again(monkeypatch: pytest.MonkeyPatch) -> None:
    page = 'import json, sys; print(json.dumps({"url": sys.argv[-1]}), flush=True); sys.stdin.read()'
    monkeypatch.setattr(viewer_child, "_COMMAND", (sys.executable, "-c", page))
    told: list[str] = []
    viewer = ViewerChild("127.0.0.1:0", told.append)
    target: Any = SimpleNamespace(
        link=SimpleNamespace(address=NOBODY, control=None, map="default"), keys=None
    )
    with viewer_child.showing(viewer, target, "out/3"):
        assert eventually(lambda: told == ["--again=out/3"], DEADLINE)


def test_a_page_with_too_much_memory_begins_again_at_its_address(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    shown: list[str] = []

    def run(page: LivePage, stop: threading.Event, *, memory_bytes: int) -> None:
        assert memory_bytes >= 2 << 30
        place = f"http://127.0.0.1:{page._server.get_port()}"
        shown.append(place)
        assert status_of(place) == HTTPStatus.OK
        if len(shown) == 2:
            stop.set()
        else:
            usual(page, stop, memory_bytes=1)

    usual = LivePage.run
    monkeypatch.setattr(LivePage, "run", run)
    monkeypatch.setattr("tsfusion.core.process.limit_memory", lambda most: None)
    arguments: Any = (None, NOBODY)
    options = {"listen": "127.0.0.1:0", "no_browser": True, "json": True}
    with pytest.raises(MemoryError, match="the page's process may take 0 MB"):
        view_command.view(*arguments, **options)  # it began a moment ago
    shown.clear()
    capsys.readouterr()
    monkeypatch.setattr(view_command, "_LEAST_SECONDS", -1.0)
    assert view_command.view(*arguments, **options) == 0
    assert json.loads(capsys.readouterr().out)["url"] == shown[0] == shown[1]
    assert "it begins again" in caplog.text
