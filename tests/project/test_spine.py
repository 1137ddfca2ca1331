# SPDX-License-Identifier: MIT
"""The files of spine.txt are those that a keyframe enters, from `Client.send` until its surface is known."""

import subprocess
import sys
from pathlib import Path

import pytest
from keyframes_and_servers import DEADLINE, serving
from repository import ROOT, SUPPORT

PACKAGE, HERE = ROOT / "tsfusion", Path(__file__).parent
IDLE, KEYFRAME = 1, 2  # values of the byte that all processes see: which files are written down, if any

# A keyframe enters them only because they are asked whether they have work.
ASKED = """
core/number_ranges.py core/limits.py fuser/departures.py fuser/kept_answers.py
fuser/pose_mover.py fuser/question_answers.py geometry/up_direction.py
tsdf/answers/map_slices.py tsdf/integration/carved_blocks.py
tsdf/store/clear_blocks.py
"""

# Writes down each function that a process calls, once for each value of the byte; a file for each process.
_RECORDER = f"""
import mmap, os, sys, threading
folder = {{folder!r}}
switch = mmap.mmap(os.open(f"{{{{folder}}}}/switch", os.O_RDWR), 1)
entered = open(f"{{{{folder}}}}/entered-{{{{os.getpid()}}}}", "w", buffering=1)
seen = set()
def write_down(frame, event, argument):
    code = frame.f_code
    step = (switch[0], code.co_filename, code.co_name, code.co_firstlineno)
    if step[0] and event == "call" and step not in seen and step[1].startswith({str(PACKAGE)!r}):
        seen.add(step)
        print(*step, sep="\\t", file=entered)
threading.setprofile(write_down)
sys.setprofile(write_down)
"""
_FUSER = "from tsfusion.fuser.__main__ import main\nsys.exit(main())"
_CLIENT = f"""
import time
sys.path.insert(0, {str(SUPPORT)!r})
from keyframes_and_servers import wall
from tsfusion import Client
with Client(sys.argv[1]) as client:
    for number in range(6):
        if number == 5:
            time.sleep(5)
            switch[0] = {IDLE}
            time.sleep(3)
            switch[0] = {KEYFRAME}
        client.send(wall(number))
        client.wait_meshed(timeout={DEADLINE})
    switch[0] = 0
"""


@pytest.mark.nightly
def test_a_keyframe_enters_files_of_the_spine_alone(tmp_path: Path) -> None:
    (tmp_path / "switch").write_bytes(b"\0")
    recorder = _RECORDER.format(folder=str(tmp_path))
    fuser = (sys.executable, "-c", recorder + _FUSER)
    with serving(tmp_path / "state", code=recorder, fuser=fuser) as server:
        command = [sys.executable, "-c", recorder + _CLIENT, server.address]
        subprocess.run(command, check=True, timeout=4 * DEADLINE)
    files = list(tmp_path.glob("entered-*"))
    assert len(files) == 3, "client, gateway and fuser"
    calls = {line for file in files for line in file.read_text().splitlines()}
    idle, for_keyframe = (
        {tuple(call.split("\t")[1:]) for call in calls if call.startswith(f"{step}\t")}
        for step in (IDLE, KEYFRAME)
    )
    entered = {str(Path(file).relative_to(PACKAGE)) for file, *_ in for_keyframe - idle}
    spine = set((HERE / "spine.txt").read_text(encoding="utf-8").split())
    assert len(entered & spine) > 30
    assert entered - spine <= set(ASKED.split()), "a keyframe takes a way that spine.txt does not know"
