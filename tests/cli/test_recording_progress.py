"""What ``turnscan record`` shows while it runs: on a terminal, and in words."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import threading
from pathlib import Path

from console import Console, surroundings
from rig_files import write_rig

from turnscan.cli.recording_progress import progress_text
from turnscan.ingest.session.order import Progress


def test_a_moment_in_words() -> None:
    now = Progress(
        angle_rad=0.5,
        done=10,
        total=40,
        frames=20,
        frames_per_s=2.5,
        dropped=3,
        failed_poses=1,
        backlog_bytes=0,
        left_s=75.2,
    )
    text = progress_text(now, None)
    assert text == "28.6 deg, 20 frames, 2.5/s, 3 dropped, 1 poses skipped, 1:15 left"


def test_a_terminal_shows_a_live_line(console: Console, tmp_path: Path) -> None:
    console("init", "lab")
    console.archive = tmp_path / "lab"
    write_rig(tmp_path, scan={"to_deg": 100})
    ours, theirs = pty.openpty()
    seen = bytearray()

    def read() -> None:
        try:
            while data := os.read(ours, 4096):
                seen.extend(data)
        except OSError:
            return  # the last writer has closed it

    thread = threading.Thread(target=read)
    thread.start()
    done = subprocess.run(
        console.command("record", "--json"),
        stdout=subprocess.PIPE,
        stderr=theirs,
        stdin=subprocess.DEVNULL,
        check=False,
        cwd=tmp_path,
        env=surroundings({"COLUMNS": "140", "TERM": "xterm"}),
        timeout=120,
    )
    os.close(theirs)
    thread.join(10)
    os.close(ours)
    text = seen.decode(errors="replace")
    assert done.returncode == 0, text
    assert done.stdout.startswith(b"{"), "data goes to stdout alone"
    for word in (
        r"\d+\.\d deg",
        r"\d+ frames",
        r"\d+\.\d/s",
        r"0 dropped",
        r"\d+:\d\d left",
        "recording",
    ):
        assert re.search(word, text), (word, text[-2000:])
