# SPDX-License-Identifier: MIT
"""Keys: the command, the files and who may read them, and the list that a server follows."""

import errno
import json
import logging
import os
import stat
import string
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import zmq
import zmq.auth
from command_processes import Here, tsfusion
from failures import refuse

from tsfusion.core.errors import InvalidConfig, OutputError
from tsfusion.wire.keys import key_folder
from tsfusion.wire.keys.key_folder import AllowedClient, AllowList
from tsfusion.wire.sockets import curve
from tsfusion.wire.sockets.curve import client_keys

Run = Callable[..., str]


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def key(first: str = "") -> str:
    """A public key; one that begins with a dash looks like an option."""
    while True:
        made = zmq.curve_keypair()[0].decode()
        if made.startswith(first or tuple(string.ascii_letters)):
            return made


@pytest.fixture
def server(tmp_path: Path) -> Path:
    """A server's folder that allows nobody yet."""
    key_folder.create_pair(tmp_path / "server-keys", "server")
    return tmp_path / "server-keys"


@pytest.fixture
def one(server: Path) -> str:
    """A key that the server allows, as robot1."""
    made = key()
    key_folder.allow(server, "robot1", made)
    return made


@pytest.fixture
def run(here: Here) -> Run:
    """Run `tsfusion keys …` in an empty folder; its output, or its error."""

    def command(*words: object, status: int = 0) -> str:
        done = here("keys", *words)
        assert done.returncode == status, done
        return done.stderr if status else done.stdout

    return command


# --- the command ---


def test_three_steps_let_a_robot_in(run: Run, tmp_path: Path) -> None:
    """As the help says it, the robot's folder elsewhere."""
    printed = run("new", "server")
    assert "tsfusion serve --keys tsfusion-keys" in printed
    step2 = run("new", "robot1", "--dir", "on-robot")
    public = step2.splitlines()[0].split()[-1]
    assert f"tsfusion keys allow robot1 '{public}'" in step2
    assert run("allow", "robot1", public) == "robot1 may connect\n"
    listed = json.loads(run("list", "--json"))
    assert listed["allowed"] == {"robot1": public}
    assert list(listed["own"]) == ["server"]
    assert f"allowed  robot1  {public}" in run("list")

    given = client_keys("on-robot/robot1.key_secret", listed["own"]["server"])
    assert given is not None
    assert (given.public, given.server) == (public, listed["own"]["server"])
    assert client_keys("on-robot/robot1.key_secret", "tsfusion-keys/server.key") == given
    assert AllowList("tsfusion-keys").name_of(public) == "robot1"


def test_the_files_are_certificates(server: Path) -> None:
    public, secret = zmq.auth.load_certificate(server / "server.key_secret")
    assert curve.server_keys(server) == curve.ServerKeys(public.decode(), (secret or b"").decode())
    assert zmq.auth.load_certificate(server / "server.key") == (public, None)
    assert public[:1].isalnum()  # not an option, wherever it stands


def test_keys_of_pyzmq_are_taken(server: Path, tmp_path: Path) -> None:
    public, secret = zmq.auth.create_certificates(tmp_path, "robot")
    assert key_folder.allow(server, "robot", public) is None
    with pytest.raises(InvalidConfig, match=r"others can read the secret key .*chmod 600"):
        client_keys(secret, public)
    os.chmod(secret, 0o600)
    given = client_keys(secret, public)
    assert given is not None
    assert AllowList(server).name_of(given.public) == "robot"


def test_nothing_is_overwritten_without_force(run: Run) -> None:
    run("new", "robot1")
    before = Path("tsfusion-keys/robot1.key_secret").read_text()
    assert "robot1.key_secret exists; choose another name, or replace it by --force" in run(
        "new", "robot1", status=1
    )
    assert Path("tsfusion-keys/robot1.key_secret").read_text() == before
    run("new", "robot1", "--force")
    assert Path("tsfusion-keys/robot1.key_secret").read_text() != before
    assert len(list(Path("tsfusion-keys").iterdir())) == 2


def test_a_new_server_pair_keeps_the_list(run: Run) -> None:
    run("new", "server")
    run("allow", "robot1", key())
    run("new", "server", "--force")
    assert "robot1" in run("list")


def test_a_name_keeps_its_place_when_its_key_changes(server: Path) -> None:
    old, new = key(), key()
    assert key_folder.allow(server, "robot1", old) is None
    allowed = AllowList(server)
    assert key_folder.allow(server, "robot1", new) == old
    assert allowed.refresh()
    assert (allowed.name_of(old), allowed.name_of(new)) == (None, "robot1")
    assert (allowed.rejection_reason(old), allowed.rejection_reason(key())) == ("revoked", "unknown")
    assert key_folder.allow(server, "robot1", new) is None
    assert key_folder.allow(server, "robot1", old) == new
    assert key_folder.read_allow_list(server).revoked == {new: "robot1"}


def test_the_same_key_has_one_name(server: Path, one: str) -> None:
    with pytest.raises(InvalidConfig, match=r"allowed under the name robot1 already; .* revoke robot1"):
        key_folder.allow(server, "robot2", one)
    key_folder.revoke(server, "robot1")
    key_folder.allow(server, "robot2", one)
    assert key_folder.read_allow_list(server) == key_folder.Allowed({"robot2": AllowedClient(one)}, {})


def test_a_lost_list_is_begun_anew(server: Path) -> None:
    one = key()
    (server / key_folder.ALLOWED).unlink()
    key_folder.allow(server, "robot1", one)
    assert key_folder.read_allow_list(server) == key_folder.Allowed({"robot1": AllowedClient(one)})


def test_a_key_that_looks_like_an_option(run: Run) -> None:
    """Ours do not; other tools make them."""
    run("new", "server")
    foreign = key("-")
    assert run("allow", "robot1", "--", foreign) == "robot1 may connect\n"
    assert json.loads(run("list", "--json"))["allowed"] == {"robot1": foreign}


def test_revoke(run: Run) -> None:
    run("new", "server")
    one = key()
    run("allow", "robot1", one)
    assert run("revoke", "robot1") == f"robot1 may no longer connect: {one}\n"
    assert f"revoked  robot1  {one}" in run("list")
    assert "no key is allowed under the name 'robot1', nor under any other" in run(
        "revoke", "robot1", status=1
    )


def test_a_key_for_some_maps(run: Run) -> None:
    run("new", "server")
    one, two = key(), key()
    assert run("allow", "robot1", one, "--maps", "house, yard-*") == (
        "robot1 may connect, and use these maps: house, yard-*\n"
    )
    run("allow", "robot2", two)
    assert f"allowed  robot1  {one}  maps: house, yard-*\n" in run("list")
    assert json.loads(run("list", "--json"))["maps"] == {"robot1": ["house", "yard-*"]}
    assert f'"robot1" = {{ key = "{one}", maps = ["house", "yard-*"] }}' in listed_text()
    assert f'"robot2" = "{two}"' in listed_text()

    new = key()
    run("allow", "robot1", new)  # with its maps
    assert f'"robot1" = {{ key = "{new}", maps = ["house", "yard-*"] }}' in listed_text()
    run("allow", "robot1", "--maps", "shed")
    assert f'"robot1" = {{ key = "{new}", maps = ["shed"] }}' in listed_text()
    assert run("allow", "robot1", "--maps", "*") == "robot1 may connect\n"
    assert f'"robot1" = "{new}"' in listed_text()
    run("allow", "robot1", "--maps", "shed")
    run("revoke", "robot1")
    run("allow", "robot1", one)
    assert f'"robot1" = "{one}"' in listed_text()


def test_a_key_that_may_forget_what_others_sent(run: Run) -> None:
    run("new", "server")
    one, two = key(), key()
    assert run("allow", "desk", one, "--forget") == (
        "desk may connect; it may forget keyframes of others, too\n"
    )
    run("allow", "robot1", two, "--maps", "house", "--forget")
    assert f'"desk" = {{ key = "{one}", forget = true }}' in listed_text()
    assert f'"robot1" = {{ key = "{two}", maps = ["house"], forget = true }}' in listed_text()
    assert f"allowed  desk    {one}  forgets others'\n" in run("list")
    run("allow", "robot1", "--maps", "*")
    assert json.loads(run("list", "--json"))["forget"] == ["desk", "robot1"]
    run("allow", "robot1", "--no-forget")
    assert f'"robot1" = "{two}"' in listed_text()
    run("revoke", "desk")
    run("allow", "desk", one)
    assert f'"desk" = "{one}"' in listed_text()


def listed_text() -> str:
    return Path("tsfusion-keys/allowed.toml").read_text()


def test_a_list_follows_the_maps_of_its_names(server: Path, one: str) -> None:
    allowed = AllowList(server)
    assert "house" in allowed.maps_of("robot1")
    assert "house" not in allowed.maps_of("robot2")
    path = server / key_folder.ALLOWED

    def write(entry: str) -> bool:
        path.write_text(f"[allowed]\nrobot1 = {entry}\n")
        return allowed.refresh()

    assert write(f"{{key = '{one}', maps = ['yard-*']}}")
    maps = allowed.maps_of("robot1")
    assert [name in maps for name in ("yard-1", "yard", "house")] == [True, False, False]
    assert write(f"{{key = '{one}', maps = []}}")
    assert "house" not in allowed.maps_of("robot1")
    assert write(f"{{key = '{one}', maps = ['yard', '*']}}")
    assert not write(f"'{one}'"), "every map, as before"
    for bad in ("maps = ['../x']", "maps = ['a*b']", "maps = 'yard'", "map = ['yard']", "maps = ['ya\\n']"):
        assert write(f"{{key = '{one}', {bad}}}")
        assert "damaged" in allowed.problem
        assert write(f"'{one}'") is False


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["new", "../evil"], "a name is 1 to 32 letters"),
        (["new", "a" * 33], "a name is 1 to 32 letters"),
        (["new", "robot\n"], "a name is 1 to 32 letters"),
        (["allow", "a b", "KEY"], "a name is 1 to 32 letters"),
        (["allow", "robot1"], "no key is allowed under the name 'robot1' yet: give its public key, too"),
        (["allow", "robot1", "KEY", "--maps", "Yard"], "maps are names of 1 to 32 of a-z"),
        (["allow", "robot1", "KEY", "--maps", "ya*rd"], "the last may be `*`; got 'ya*rd'"),
        (["allow", "robot1", "KEY", "--maps", ","], "maps are names of 1 to 32 of a-z"),
        (["allow", "robot1", "short"], "a public key is a file or 40 characters, got 'short'"),
        (["allow", "robot1", "#" * 40], "a public key is a file or 40 characters"),  # more than 32 bits
        (["allow", "robot1", "ä" * 40], "a public key is a file or 40 characters"),
        (["allow", "robot1", "empty"], "empty holds no public key"),
        (["allow", "robot1", "damaged.key"], "damaged.key is damaged: its public key is not 40 characters"),
        (["allow", "robot1", "tsfusion-keys/server.key"], "that is the server's own"),
        (["allow", "robot1", "tsfusion-keys/server.key_secret"], "holds a secret key, which stays on"),
        (["allow", "robot1", "KEY", "--dir", "missing"], "`tsfusion keys new server` makes"),
        (["allow", "robot1", "KEY", "--dir", "robots"], "server.key_secret does not exist"),
        (["allow", "server", "KEY"], "that is the server's own"),
        (["revoke", "robot9", "--dir", "robots"], "cannot read the allow-list"),
        (["revoke", "robot9"], "no key is allowed under the name 'robot9', nor under any other"),
        (["list", "--dir", "missing"], "cannot read the folder missing"),
        (["list", "--dir", "empty"], "empty is not a folder"),
        (["list", "--dir", "open"], "others can change the folder open (mode 0777): run `chmod 700 open`"),
        (["new", "robot1", "--dir", "open"], "others can change the folder open"),
        (["new", "robot1", "--dir", "empty/x"], "cannot make the folder empty/x"),
    ],
)
def test_a_mistake_is_one_clear_line(run: Run, words: list[str], message: str, tmp_path: Path) -> None:
    run("new", "server")
    run("new", "robot9", "--dir", "robots")
    (tmp_path / "empty").write_text("")
    (tmp_path / "damaged.key").write_text('curve\n    public-key = "0123456789"\n')
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    said = run(*(key() if word == "KEY" else word for word in words), status=1)
    assert message in said
    assert said.count("\n") == 1
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_real_process_and_its_environment(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tsfusion", "keys", "new", "server"],
        env={**os.environ, "TSFUSION_KEYS": str(tmp_path / "here")}, check=True, capture_output=True,
        text=True, timeout=60,
    )  # fmt: skip
    assert "public key of server" in done.stdout
    help_ = tsfusion("keys", "--help").stdout
    assert all(f"{number}. on the" in help_ for number in (1, 2, 3))
    assert curve.server_keys(tmp_path / "here").public in done.stdout


# --- files ---


def test_files_are_private_from_their_first_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However permissive the umask is, and also while they are being written."""
    modes, real_fsync = [], os.fsync

    def watched(handle: int) -> None:
        modes.append(stat.S_IMODE(os.fstat(handle).st_mode))
        real_fsync(handle)

    monkeypatch.setattr(os, "fsync", watched)
    before = os.umask(0)
    try:
        key_folder.create_pair(tmp_path / "keys", "server")
        key_folder.allow(tmp_path / "keys", "robot1", key())
    finally:
        os.umask(before)
    assert set(modes) == {0o600, 0o700}  # files, and their folder
    assert mode(tmp_path / "keys") == 0o700
    assert {path.name: mode(path) for path in (tmp_path / "keys").iterdir()} == {
        "server.key": 0o600, "server.key_secret": 0o600, "allowed.toml": 0o600
    }  # fmt: skip


def test_a_failed_write_changes_nothing(server: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key_folder.allow(server, "robot1", key())
    before = (server / key_folder.ALLOWED).read_bytes()

    monkeypatch.setattr(os, "fsync", refuse(errno.ENOSPC))
    with pytest.raises(OutputError, match="No space left"):
        key_folder.allow(server, "robot2", key())
    with pytest.raises(OutputError, match="No space left"):
        key_folder.create_pair(server, "robot3")
    assert (server / key_folder.ALLOWED).read_bytes() == before
    assert {path.name for path in server.iterdir()} == {"server.key", "server.key_secret", "allowed.toml"}


def test_many_at_once_lose_nothing(server: Path) -> None:
    program = "import sys; from tsfusion.wire.keys import key_folder as keys; keys.allow(*sys.argv[1:])"
    names = [f"robot{i}" for i in range(6)]
    children = [subprocess.Popen([sys.executable, "-c", program, str(server), name, key()]) for name in names]
    assert [child.wait(60) for child in children] == [0] * len(names)
    assert sorted(key_folder.read_allow_list(server).clients) == names


@pytest.mark.parametrize("others", [0o640, 0o604, 0o620, 0o660])
def test_a_secret_that_others_can_read_is_refused(server: Path, others: int) -> None:
    (server / "server.key_secret").chmod(others)
    with pytest.raises(InvalidConfig, match=f"others can read the secret key .*mode {others:04o}"):
        curve.server_keys(server)


def test_a_damaged_pair_is_refused(server: Path, tmp_path: Path) -> None:
    path = server / "server.key_secret"
    text = path.read_text()
    path.write_text(text.replace(curve.server_keys(server).public, key()))
    with pytest.raises(InvalidConfig, match="its public key does not belong to its secret key"):
        curve.server_keys(server)
    path.write_text(text.replace("secret-key", "sacred-key"))
    with pytest.raises(InvalidConfig, match="holds no secret key"):
        curve.server_keys(server)
    path.write_bytes(b"\xff\x00" * 5000)
    with pytest.raises(InvalidConfig, match="holds no secret key"):
        curve.server_keys(server)


def test_both_keys_or_none() -> None:
    assert client_keys(None, None) is None
    with pytest.raises(InvalidConfig, match="key needs server_key, too"):
        client_keys("robot1.key_secret", None)
    with pytest.raises(InvalidConfig, match="server_key needs key, too"):
        client_keys(None, key())
    with pytest.raises(InvalidConfig, match=r"cannot read the key missing\.key_secret"):
        client_keys("missing.key_secret", key())


def test_secrets_are_not_printed(server: Path) -> None:
    own = curve.server_keys(server)
    for shown in (own, curve.ClientKeys(own.public, own.secret, key())):
        assert own.secret not in f"{shown} {shown!r} {[shown]}"


# --- the list that a server follows ---


def test_the_list_is_read_again_only_when_it_changes(server: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = key(), key()
    allowed = AllowList(server)
    reads, real = [], key_folder.read_allow_list

    def counted(folder: Path) -> key_folder.Allowed:
        reads.append(folder)
        return real(folder)

    monkeypatch.setattr(key_folder, "read_allow_list", counted)
    assert not allowed.refresh()
    assert not reads
    key_folder.allow(server, "robot1", one)
    assert not allowed.refresh()  # somebody more: nobody's connection need be cut
    assert (allowed.name_of(one), allowed.name_of(None)) == ("robot1", None)
    key_folder.allow(server, "robot2", two)
    assert not allowed.refresh()
    key_folder.revoke(server, "robot1")
    reads.clear()
    assert allowed.refresh()
    assert not allowed.refresh()
    assert len(reads) == 1
    assert (allowed.name_of(one), allowed.name_of(two)) == (None, "robot2")
    assert allowed.rejection_reason(one) == "revoked"


def test_a_key_under_another_name_is_another_client(server: Path, one: str) -> None:
    allowed = AllowList(server)
    key_folder.revoke(server, "robot1")
    key_folder.allow(server, "robot2", one)
    assert allowed.refresh()
    assert allowed.name_of(one) == "robot2"


@pytest.mark.parametrize(
    "content",
    [
        *(None, b"", b"\xff\xfe", b"[allowed", b"allowed = 3\n", b"[allow]\n", b"x = " + b"[" * 9000),
        b'[allowed]\nrobot1 = "short"\n',
        b'[allowed]\n"../x" = "KEY"\n',
        b'[allowed]\nrobot1 = "KEY"\nrobot2 = "KEY"\n',
        b'[allowed]\nrobot1 = "KEY"\n[revoked]\n"KEY" = "robot1"\n',
        b"#" * ((1 << 20) + 1),
    ],
)
def test_a_list_that_cannot_be_read_lets_nobody_in(
    server: Path, one: str, content: bytes | None, caplog: pytest.LogCaptureFixture
) -> None:
    allowed = AllowList(server)
    good = (server / key_folder.ALLOWED).read_bytes()
    caplog.clear()
    if content is None:
        (server / key_folder.ALLOWED).unlink()
    else:
        (server / key_folder.ALLOWED).write_bytes(content.replace(b"KEY", one.encode()))
    assert [allowed.refresh() for _ in range(4)] == [True, False, False, False]
    assert allowed.name_of(one) is None
    if content == b"":  # an empty list is a list
        assert not allowed.problem
    else:
        assert allowed.problem
        assert allowed.rejection_reason(one) == "allow-list"
        assert [record.levelno for record in caplog.records] == [logging.ERROR]
        assert "nobody is allowed to connect" in caplog.text
    (server / key_folder.ALLOWED).write_bytes(good)
    assert not allowed.refresh()
    assert (allowed.name_of(one), allowed.problem) == ("robot1", "")


def test_a_list_that_others_can_change_lets_nobody_in(server: Path, one: str) -> None:
    allowed = AllowList(server)
    (server / key_folder.ALLOWED).chmod(0o666)
    assert allowed.refresh()
    assert "others can change the allow-list" in allowed.problem
    (server / key_folder.ALLOWED).chmod(0o600)
    allowed.refresh()
    assert allowed.name_of(one) == "robot1"


def test_a_stale_list_is_tried_again_though_its_file_is_the_same(
    server: Path, one: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.chmod(0o777)
    allowed = AllowList(server)
    assert "others can change the folder" in allowed.problem
    server.chmod(0o700)
    monkeypatch.setattr(allowed, "_again", 0.0)
    allowed.refresh()
    assert allowed.name_of(one) == "robot1"


def test_a_new_key_for_some_maps_is_no_change_for_others(server: Path, one: str) -> None:
    allowed = AllowList(server)
    key_folder.allow(server, "robot3", key(), maps=["yard"])
    assert not allowed.refresh()
