# SPDX-License-Identifier: MIT
"""Many workers make the map of one: whatever is shared out, killed, interrupted or left out."""

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from command_processes import Here, alive, descendants, end, eventually, read_until, started, tsfusion
from corrected_maps import fresh_map
from formula_scenes import free_space
from keyframes_and_servers import VOLUME, pose, wall
from saved_maps import make_map
from silent_display import Silent
from small_recordings import corbs, kitti, redwood

from tsfusion import Volume
from tsfusion.cluster import fusion, job_runner, jobs, keyframe_sources, ray_scheduler
from tsfusion.cluster.fusion import FusedRun, Wishes
from tsfusion.cluster.jobs import AnyJob, JobLost, JobMessage
from tsfusion.cluster.schedulers import ATTEMPTS
from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import InvalidConfig, JournalError, MapError, OutputError, WorkerLost
from tsfusion.journal import Journal, segment_path
from tsfusion.wire.records import codec, corrections

SESSION, COUNT = b"\xab" * 16, 12
pytestmark = pytest.mark.usefixtures("quick_servers")


class InThisProcess:
    """A scheduler whose workers are this process; `lose` names jobs whose worker ends, and how often."""

    name = "here"

    def __init__(self, workers: int = 1, lose: dict[str, int] | None = None) -> None:
        self.workers, self._lose = workers, dict(lose or {})
        self._started: list[AnyJob] = []
        self.done: list[str] = []

    def start(self, job: AnyJob) -> None:
        self._started.append(job)

    def wait(self) -> Sequence[JobMessage]:
        job = self._started.pop()  # the last first: any order will do
        found = list(job_runner.run(job))
        kind = job.name.partition("-")[0]
        if self._lose.get(kind, 0):
            self._lose[kind] -= 1
            jobs.done_file(Path(job.folder), job.name).unlink(missing_ok=True)
            return [JobLost(job.name, "it was killed")]
        self.done.append(job.name)
        return found

    def close(self) -> None:
        pass


def write_journal(
    folder: Path,
    count: int = COUNT,
    session: bytes = SESSION,
    *,
    step: float = 0.03,
    far: float = 0.003,
    **fields: Any,
) -> Path:
    """A journal of walls, the last one farther away. Its last record moves one, and takes one away."""
    journal = Journal(folder / "journal", 1 << 16)
    for seq in range(1, count + 1):
        keyframe = wall(seq, T_world_camera=pose(step * seq), depth_scale=far if seq == count else 0.001)
        frames = codec.encode(keyframe, jpeg_quality=90, session=session, seq=seq, **fields)
        journal.append(frames, session=session, seq=seq)
    change = corrections.checked({3: pose(0.5)}, removed=[4])
    frames = corrections.encode(change, session=session, seq=count + 1)
    journal.append(frames, session=session, seq=count + 1)
    journal.close()
    return folder


@pytest.fixture
def state(tmp_path: Path) -> Path:
    return write_journal(tmp_path / "map")


@pytest.fixture
def expected(state: Path) -> Volume:
    """The map of one process, at final poses."""
    return fresh_map(state / "journal", VOLUME.voxel_size)


def fuse(source: Path | str, out: Path, scheduler: Any = None, **more: Any) -> FusedRun:
    found = keyframe_sources.listed([str(source)])
    wishes = Wishes(
        **{name: more.pop(name) for name in ("worker_memory", "tile_size", "sensor") if name in more}
    )
    made, display = scheduler or InThisProcess(3), Silent()
    run = fusion.fuse(found, more.pop("config", VOLUME), out, lambda: made, display, wishes=wishes, **more)
    assert display.shown[-1] == (found.count, run.keyframes_fused, found.count)
    return run


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_the_map_is_that_of_one_machine(state: Path, tmp_path: Path, expected: Volume, workers: int) -> None:
    run = fuse(state, tmp_path / "out", InThisProcess(workers))
    made = Volume.load(tmp_path / "out/map.tsf")
    assert run.map_hash == made.map_hash() == expected.map_hash()
    assert made.color_hash() == expected.color_hash()
    assert free_space(made) == free_space(expected) != {}
    assert (run.keyframes, run.keyframes_fused, made.held.numbers) == (11, 11, expected.held.numbers)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "map.tsf", "mesh.glb", "mesh.ply", "run.json",
    ]  # fmt: skip
    record = msgspec.json.decode((tmp_path / "out/run.json").read_bytes(), type=FusedRun)
    assert record.map_hash == run.map_hash
    whole = expected.extract_mesh()
    assert run.mesh["vertices"] == len(whole.vertices)


def test_a_worker_that_dies_is_replaced(state: Path, tmp_path: Path, expected: Volume) -> None:
    run = fuse(state, tmp_path / "out", InThisProcess(9, lose={"fuse": 3, "add": 2, "mesh": 1}))
    assert (run.map_hash, run.workers_lost) == (expected.map_hash(), 6)


def test_a_job_that_ends_every_worker_is_told(state: Path, tmp_path: Path) -> None:
    with pytest.raises(WorkerLost, match=f"cost {ATTEMPTS} workers, one after the other; it was killed"):
        fuse(state, tmp_path / "out", InThisProcess(lose={"fuse": ATTEMPTS}))


def test_an_interrupted_run_goes_on(state: Path, tmp_path: Path, expected: Volume) -> None:
    class Interrupted(InThisProcess):
        def wait(self) -> Sequence[JobMessage]:
            if len(self.done) == 3:
                raise KeyboardInterrupt
            return super().wait()

    with pytest.raises(KeyboardInterrupt):
        fuse(state, tmp_path / "out", Interrupted(5))
    assert [path.name for path in (tmp_path / "out").iterdir()] == [fusion.WORK]
    second = InThisProcess(5)
    run = fuse(state, tmp_path / "out", second)
    assert (run.map_hash, run.jobs_found) == (expected.map_hash(), 3)
    assert len(second.done) == run.jobs - 3
    with pytest.raises(OutputError, match="holds files already"):
        fuse(state, tmp_path / "out")


def zeroed(part: Path, other: Path) -> None:
    content = part.read_bytes()
    middle = len(content) // 2
    part.write_bytes(content[:middle] + bytes(64) + content[middle + 64 :])


def cut(part: Path, other: Path) -> None:
    part.write_bytes(part.read_bytes()[: part.stat().st_size // 2])


def exchanged(part: Path, other: Path) -> None:
    ours, theirs = part.read_bytes(), other.read_bytes()
    part.write_bytes(theirs)
    other.write_bytes(ours)


def listed_elsewhere(part: Path, other: Path) -> None:
    """One job's list takes the place of another's."""
    mine, theirs = (next(part.parent.glob(f"{one.name.rpartition('-')[0]}.done")) for one in (part, other))
    mine.write_bytes(theirs.read_bytes())


def unlisted(part: Path, other: Path) -> None:
    """A list of a version that wrote no digests."""
    for path in part.parent.glob("*.done"):
        found = msgspec.msgpack.decode(path.read_bytes())
        path.write_bytes(msgspec.msgpack.encode({key: one for key, one in found.items() if key != "digests"}))


@pytest.mark.parametrize("harm", [zeroed, cut, exchanged, listed_elsewhere, unlisted])
def test_a_part_that_is_not_what_its_job_wrote_is_made_anew(
    state: Path, tmp_path: Path, expected: Volume, harm: Callable[[Path, Path], None]
) -> None:
    with pytest.raises(WorkerLost):
        fuse(state, tmp_path / "out", InThisProcess(3, lose={"add": ATTEMPTS}))
    part, other, _ = sorted((tmp_path / "out" / fusion.WORK).glob("fuse-*.tsf"))
    harm(part, other)
    again = InThisProcess(3)
    assert fuse(state, tmp_path / "out", again).map_hash == expected.map_hash()
    made_anew = {zeroed: 1, cut: 1, exchanged: 2, listed_elsewhere: 1, unlisted: 3}[harm]
    assert sum(name.startswith("fuse") for name in again.done) == made_anew


def test_other_keyframes_or_settings_begin_anew(state: Path, tmp_path: Path) -> None:
    with pytest.raises(WorkerLost):
        fuse(state, tmp_path / "out", InThisProcess(lose={"mesh": ATTEMPTS}))
    coarse = msgspec.structs.replace(VOLUME, voxel_size=0.08)
    run = fuse(state, tmp_path / "out", config=coarse)
    assert run.jobs_found == 0
    assert run.map_hash == fresh_map(state / "journal", 0.08).map_hash()
    with pytest.raises(WorkerLost):
        fuse(state, tmp_path / "other", InThisProcess(lose={"mesh": ATTEMPTS}))
    other = fuse(state, tmp_path / "other", sensor="scanner")  # which all keyframes are taken to be of
    assert other.jobs_found == 0
    assert other.map_hash != fresh_map(state / "journal", VOLUME.voxel_size).map_hash()


@pytest.mark.parametrize("change", ["trajectory.log", "depth/00001.png", "camera-intrinsics.txt"])
def test_a_recording_that_was_mended_begins_anew(tmp_path: Path, change: str) -> None:
    recording = redwood(tmp_path / "recording", list(range(4)), list(range(4)))
    for image in recording.glob("depth/*"):
        cv2.imwrite(str(image), np.full((6, 8), 1500, np.uint16))

    def jobs_done() -> list[str]:
        """Names of the jobs that a run does before it fails; its results lie in the recording."""
        scheduler = InThisProcess(lose={"mesh": ATTEMPTS})
        with pytest.raises(WorkerLost):
            fuse(recording, recording / "out", scheduler, overwrite=True)
        return scheduler.done

    (recording / "out").mkdir()
    for name in ("run.json", "mesh.ply", "preview.png"):  # of an earlier run
        (recording / "out" / name).touch()
    assert jobs_done() != []
    assert jobs_done() == []
    (recording / "fuse.log").touch()
    assert jobs_done() == []
    os.utime(recording / change, (1, 1))
    if change == "trajectory.log":  # of which the poses count
        assert jobs_done() == []
        (recording / change).write_text((recording / change).read_text().replace("0 1 0 0", "0 1 0 9"))
    assert jobs_done() != []


def test_what_the_map_did_not_take_is_not_missed(tmp_path: Path) -> None:
    folder = make_map(tmp_path / "state" / "maps" / "default", range(4), refused=(1, 2, 3, 4))
    make_map(folder, range(4, 8))
    segment_path(folder / "journal", 1).unlink()  # of which the map has nothing
    assert keyframe_sources.listed([str(tmp_path / "state")]).absent == 0


def test_the_folder_above_a_recording_may_be_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = redwood(tmp_path / "home" / "recording", list(range(4)), list(range(4)))
    real = Path.iterdir

    def iterdir(path: Path) -> Any:
        if path == recording.parent:  # as to another user, in a folder of mode 711
            raise PermissionError(13, "Permission denied")
        return real(path)

    opened = keyframe_sources.open_dataset(recording)
    monkeypatch.setattr(Path, "iterdir", iterdir)
    assert len(keyframe_sources._state(opened, str(recording), {})) == 32


def test_keyframes_that_the_journal_no_longer_has_are_told(here: Here, tmp_path: Path) -> None:
    folder = make_map(tmp_path / "state" / "maps" / "default", range(4))
    make_map(folder, range(4, 8))  # in a segment of their own
    segment_path(folder / "journal", 1).unlink()
    for command, *flags in (("fuse", "--workers", 1), ("replay", "--no-check")):  # the walls of this map move
        done = here(command, tmp_path / "state", "--out", tmp_path / command, *flags)
        assert done.returncode == 1
        assert "the journal no longer has 4 keyframes of the map" in done.stderr.splitlines()[-1]
        assert (tmp_path / command / "mesh.ply").is_file()
    assert keyframe_sources.listed([str(segment_path(folder / "journal", 2))]).absent == 0


def test_a_recording_of_which_much_cannot_be_read_is_no_success(here: Here, tmp_path: Path) -> None:
    recording = redwood(tmp_path / "recording", list(range(12)), list(range(12)))
    for number, image in enumerate(sorted(recording.glob("depth/*"))):
        cv2.imwrite(str(image), np.full((6, 8), 1500, np.uint16))
        if number % 3 == 1:
            image.write_bytes(b"")
    coarse = ("--voxel-size", 0.2, "--min-weight", 0)
    done = here("fuse", recording, "--workers", 1, *coarse, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert "4 of 12 frames cannot be read, and are not in the map" in done.stderr.splitlines()[-1]
    assert (tmp_path / "out" / "mesh.ply").is_file()


@pytest.mark.parametrize("command", ["fuse", "replay"])
def test_results_never_replace_a_servers_map(here: Here, tmp_path: Path, command: str) -> None:
    folder = make_map(tmp_path / "state" / "maps" / "default", range(2))
    content = (folder / "map.tsf").read_bytes()
    done = here(command, "synthetic:room", "--option", "count=2", "--out", folder, "--overwrite")
    assert "a server keeps its map there" in done.stderr
    own = ("--state", tmp_path / "state", "--no-check")
    again = here("replay", tmp_path / "state", *own, "--out", tmp_path / "again")
    assert "its keyframes would count twice there" in again.stderr
    assert (done.returncode, again.returncode) == (1, 1)
    assert (folder / "map.tsf").read_bytes() == content


def test_a_map_larger_than_a_workers_memory_goes_out_in_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    street = write_journal(tmp_path / "street", step=1.0, far=0.001)
    expected = fresh_map(street / "journal", VOLUME.voxel_size)
    most = expected.stats().bytes // 3
    monkeypatch.setattr(job_runner, "_budget", lambda *_: most)
    run = fuse(street, tmp_path / "out", InThisProcess(1), worker_memory=1 << 40)
    assert run.map_hash == expected.map_hash()
    assert run.jobs >= 4  # a sum was made of a single job's keyframes; the mesh, and tiles
    assert (tmp_path / "out/tiles/tileset.json").is_file()
    assert run.mesh["triangles"] == len(expected.extract_mesh().faces)


def test_keyframes_that_a_map_cannot_take_are_counted(state: Path, tmp_path: Path) -> None:
    small = msgspec.structs.replace(VOLUME, max_blocks_per_keyframe=1)
    with pytest.raises(OutputError, match="no surface to write"):
        fuse(state, tmp_path / "out", config=small)
    narrow = msgspec.structs.replace(VOLUME, max_blocks_per_keyframe=200)
    run = fuse(state, tmp_path / "out", config=narrow)
    assert (run.keyframes, run.keyframes_fused, list(run.keyframes_rejected.values())) == (11, 10, [1])


def test_what_is_no_sum_is_refused(state: Path, tmp_path: Path) -> None:
    smoothing = msgspec.structs.replace(VOLUME, regularizer="ray")
    with pytest.raises(InvalidConfig, match="smoothing along rays depends on the order"):
        fuse(state, tmp_path / "out", config=smoothing)


def test_sources_that_do_not_add_up_are_refused(
    state: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for twice in (str(state), f"{state}/."), ("synthetic:room", "synthetic:room"):
        with pytest.raises(MapError, match="is given 2 times"):
            keyframe_sources.listed(twice)
    (tmp_path / "again").symlink_to(state)
    for again in (str(tmp_path / "again"), f"file://{state}"):
        with pytest.raises(MapError, match="is given 2 times"):
            keyframe_sources.listed([str(state), again])
    whole = tmp_path / "recording"
    (whole / "first").mkdir(parents=True)
    (tmp_path / "part").symlink_to(whole / "first")
    with pytest.raises(MapError, match=f"part lies in {whole}: its keyframes would count twice"):
        keyframe_sources.listed([str(tmp_path / "part"), str(whole)])
    copy = shutil.copytree(state / "journal", tmp_path / "copy")
    for other in (state / "journal", tmp_path / "again" / "journal", copy):
        with pytest.raises(MapError, match="both hold 11 keyframes of the same session"):
            keyframe_sources.listed([str(state), str(other)])
    one, other = (
        write_journal(tmp_path / name, 5, bytes([i] * 16), world=name)
        for i, name in enumerate(("one", "two"), 1)
    )
    with pytest.raises(MapError, match="coordinate frame of its own"):
        keyframe_sources.listed([str(one), str(other)])
    given = str(write_journal(tmp_path / "given", 5, bytes([3] * 16)))
    keyframe_sources.listed([given])
    assert "one coordinate frame" not in caplog.text
    keyframe_sources.listed([given, "synthetic:room"], options={"count": 3}, same_frame=True)
    assert "one coordinate frame" not in caplog.text
    keyframe_sources.listed([given, "synthetic:room"], options={"count": 3})
    assert "the poses of these 2 sources are taken to be in one coordinate frame" in caplog.text
    found = keyframe_sources.listed([str(one), str(other)], same_frame=True)
    assert [len(part) for part in found.keyframes] == [4, 4]
    assert [sum(map(len, share)) for share in found.shares(3)] == [3, 2, 3]
    with pytest.raises(InvalidConfig, match="--option has no effect on a journal"):
        keyframe_sources.listed([str(one)], options={"count": 3})
    with pytest.raises(JournalError, match="does not exist"):
        keyframe_sources.listed([str(tmp_path / "none/journal.mcap")])


def test_the_settings_of_the_saved_map_are_taken(state: Path, here: Here, expected: Volume) -> None:
    Volume(VOLUME).save(state / "map.tsf", meta={"done": {}})
    done = here("fuse", state, "--workers", 2, "--out", "out", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["map_hash"] == expected.map_hash()
    assert here("map", "hash", "out/map.tsf").stdout.strip() == expected.map_hash()


def settings(path: Path) -> dict[str, Any]:
    return keyframe_sources.settings_of(keyframe_sources.saved_beside(path, None))


def test_each_place_in_a_map_names_the_saved_maps_settings(
    state: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    segment = next((state / "journal").glob("*.mcap"))
    places = [state, state / "journal", segment]
    assert [settings(path) for path in places] == [{}] * 3
    Volume(VOLUME).save(state / "map.tsf", meta={"done": {}})
    monkeypatch.chdir(state / "journal")
    places += [Path(), Path(segment.name)]
    found = [settings(path) for path in places]
    assert [VolumeConfig(**each, threads=VOLUME.threads) for each in found] == [VOLUME] * 5
    (state / "map.tsf").write_bytes(b"no map")
    assert settings(state) == {}
    assert "map.tsf" in caplog.text
    assert "its settings are not used" in caplog.text


def test_a_recording_of_a_street_says_which_voxels_are_usual(tmp_path: Path) -> None:
    kitti(tmp_path)
    found = keyframe_sources.listed([str(tmp_path)], options={"modality": "stereo"})
    assert (found.sensor, found.usual) == ("stereo", {"voxel_size": 0.1})


def test_frames_without_colour_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    keyframe_sources.listed([str(corbs(tmp_path))])
    assert "1 frame without colour in time" in caplog.text


def test_killed_and_interrupted_commands_leave_no_worker_and_go_on(tmp_path: Path) -> None:
    """Real processes: one worker is killed, then the command is interrupted, then it is run to its end."""
    command = ["fuse", "synthetic:room", "--option", "count=24", "--workers", 2, "--voxel-size", 0.05]
    out = ["--out", tmp_path / "out"]
    process = started(*command, *out)
    try:
        read_until(process, "fusing 24 keyframes")
        assert eventually(lambda: len(descendants(process.pid)) >= 2)
        workers = descendants(process.pid)
        os.kill(workers[0], signal.SIGKILL)
        read_until(process, "a worker was lost, its job begins again")
        workers += descendants(process.pid)
    finally:
        status = end(process, signal.SIGINT)
    assert status == 130
    assert eventually(lambda: not any(map(alive, workers)))
    done = tsfusion(*command, *out, "--json")
    assert done.returncode == 0, done.stderr
    whole = Volume(0.05)
    for keyframe in keyframe_sources.reading(
        keyframe_sources.listed(["synthetic:room"], options={"count": 24}).keyframes
    ):
        whole.integrate(keyframe())
    assert json.loads(done.stdout)["map_hash"] == whole.map_hash()


@pytest.mark.parametrize("address", [None, "auto"])
def test_a_ray_cluster_of_ones_own_is_loopbacks_and_asks_for_a_token(
    address: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray itself, where it is installed, is tried in test_ray_scheduler.py."""
    names = (*ray_scheduler.OWN, *ray_scheduler._QUIET, "RAY_AUTH_TOKEN")
    for name in names:
        monkeypatch.setenv(name, "")  # for what was there to come back
        monkeypatch.delenv(name)
    seen: dict[str, str] = {}
    ray = SimpleNamespace(init=lambda **_: seen.update(os.environ), remote=lambda **_: lambda do: do)
    monkeypatch.setitem(sys.modules, "ray", ray)
    ray_scheduler.RayCluster(1, address)
    token, how = seen.get("RAY_AUTH_TOKEN", ""), {name: seen.get(name) for name in ray_scheduler.OWN}
    if address is None:
        assert how == {"RAY_AUTH_MODE": "token", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
        assert len(token) == 64
    else:
        assert (token, set(how.values())) == ("", {None})
