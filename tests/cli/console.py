"""Run the turnscan script in a process of its own, and say in short what it must do."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from turnscan.cli.main import main

SCRIPT = Path(sys.executable).with_name("turnscan")


class Console:
    """``console("process", "latest")`` runs the command and fails the test unless it exits with 0."""

    def __init__(self, cwd: Path, archive: Path | None = None) -> None:
        self.cwd = cwd
        self.archive = archive

    def command(self, *words: object) -> list[str]:
        """The whole command line; --archive is put in front once there is an archive."""
        where = ["--archive", str(self.archive)] if self.archive else []
        return [str(SCRIPT), *where, *map(str, words)]

    def run(
        self, *words: object, env: Mapping[str, str] | None = None, cwd: Path | None = None
    ) -> subprocess.CompletedProcess[str]:
        """What the command did, whatever it is. Nothing of the developer's terminal reaches it."""
        return subprocess.run(
            self.command(*words),
            capture_output=True,
            text=True,
            check=False,
            cwd=cwd or self.cwd,
            env=surroundings(env),
            stdin=subprocess.DEVNULL,
            timeout=120,
        )

    def __call__(self, *words: object, **where: Any) -> subprocess.CompletedProcess[str]:
        done = self.run(*words, **where)
        assert done.returncode == 0, (done.args, done.stdout, done.stderr)
        assert "Traceback" not in done.stderr, done.stderr
        return done

    def json(self, *words: object, **where: Any) -> Any:
        """The data that the command writes with --json."""
        return json.loads(self(*words, "--json", **where).stdout)

    def fails(self, *words: object, code: int = 1, hint: bool = True, **where: Any) -> str:
        """What a failing command says: exactly one error, a way out, no traceback."""
        done = self.run(*words, **where)
        assert done.returncode == code, (done.args, done.returncode, done.stdout, done.stderr)
        assert done.stderr.count("error: ") == 1, done.stderr
        assert ("\nhint: " in done.stderr) is hint, done.stderr
        assert "Traceback" not in done.stderr, done.stderr
        return done.stderr


class Inside(Console):
    """The same entry point called in this process, for the many cases that need no process each."""

    def run(
        self, *words: object, env: Mapping[str, str] | None = None, cwd: Path | None = None
    ) -> subprocess.CompletedProcess[str]:
        assert env is None, "another environment needs another process"
        command = self.command(*words)
        out, err, code = io.StringIO(), io.StringIO(), 0
        # An error that main() does not expect comes out here as itself, and the test fails with it.
        with (
            contextlib.chdir(cwd or self.cwd),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            try:
                main(command[1:])
            except SystemExit as stop:
                assert isinstance(stop.code, int)
                code = stop.code
        return subprocess.CompletedProcess(command, code, out.getvalue(), err.getvalue())


def surroundings(more: Mapping[str, str] | None = None) -> dict[str, str]:
    """The environment of a command: none of the developer's settings, 80 columns, no colours."""
    dropped = ("TURNSCAN_ARCHIVE", "NO_COLOR", "FORCE_COLOR", "PY_COLORS", "COLUMNS", "GITHUB_ACTIONS")
    kept = {k: v for k, v in os.environ.items() if k not in dropped}
    return {**kept, "PYTHONWARNINGS": "error", **(more or {})}


def write_json(path: Path, value: Any) -> Path:
    """``value`` as a JSON file."""
    path.write_text(json.dumps(value, indent=2))
    return path


def write_frames(folder: Path, count: int, *, size: tuple[int, int] = (64, 48), seed: int = 8) -> Path:
    """``count`` PNG frames with a slanted stripe that wanders, as img0.png and on."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    width, height = size
    x = np.arange(width)
    for i in range(count):
        centre = 30 + 2 * (i % 10) + 0.05 * np.arange(height)[:, None]
        frame = 12 + 180 * np.exp(-((x - centre) ** 2) / 2 / 1.5**2)
        frame = frame + rng.normal(0, 1, (height, width))
        assert cv2.imwrite(
            str(folder / f"img{i}.png"), np.clip(np.rint(frame), 0, 255).astype(np.uint8)
        )
    return folder


def every_file(folder: Path) -> dict[str, tuple[int, int]]:
    """Modification time and size of every file in ``folder``."""
    return {
        str(p.relative_to(folder)): (p.stat().st_mtime_ns, p.stat().st_size)
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }
