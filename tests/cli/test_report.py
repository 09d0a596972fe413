"""``turnscan report denoise`` on a recorded simulation, on real frames, and on frames at one pose."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from console import Console, Inside, write_frames
from rig_files import write_rig

from turnscan.schemas.events import Exposure, ScanEnd, ScanStart, TurntableAngle
from turnscan.store import Archive
from turnscan.store.log_writer import LogWriter

FILTERS = ["none", "gaussian", "median", "gaussian-median", "median-gaussian"]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory, test_data: Path) -> Inside:
    """An archive with a simulated recording, three real frames, and twelve frames at two poses."""
    run = Inside(tmp_path_factory.mktemp("report"))
    run("init", "lab")
    run.archive = run.cwd / "lab"
    light = {"exposure_us": 1000.0}
    rig = write_rig(run.cwd / "rig", scan={"to_deg": 20, "step_deg": 5}, simulated={"light": light})
    run("record", "--rig", rig, "--label", "simulated", "--no-extract")
    real = run.cwd / "real"
    real.mkdir()
    for number in (1, 81, 161):
        shutil.copy(test_data / "srv_turntable" / "scan" / f"step_num{number}.jpg", real)
    run("import", "images", real, "--step-deg", "90", "--rig", "srv", "--label", "real")
    same = write_still(run.cwd / "still", 12)
    run("import", "images", same, "--angles", run.cwd / "still.csv", "--rig", "r", "--label", "still")
    return run


def write_still(folder: Path, count: int) -> Path:
    """Frames of one stripe with new noise each, 2 DN; the first half at 0 degrees, the rest at 10."""
    folder.mkdir()
    rng = np.random.default_rng(3)
    clean = 20 + 150 * np.exp(-0.5 * ((np.arange(120) - 50.3) / 2.0) ** 2) * np.ones((90, 1))
    rows = [["file", "angle_deg"]]
    for i in range(count):
        frame = np.rint(clean + rng.normal(0, 2.0, clean.shape)).astype(np.uint8)
        assert cv2.imwrite(str(folder / f"f{i:02d}.png"), frame)
        rows.append([f"f{i:02d}.png", "0" if i < count // 2 else "10"])
    with folder.with_suffix(".csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return folder


def test_a_simulated_scan_is_judged_by_its_truth(lab: Inside) -> None:
    made = lab.json("report", "denoise", "simulated")
    assert (made["frames"], made["peak_dn"]) == (5, 255.0)
    rows = {r["filter"]: r for r in made["rows"]}
    assert list(rows) == FILTERS
    # Read noise of 2 DN, a little shot noise, rounding.
    assert 3.9 < rows["none"]["mse_vs_truth_dn2"] < 4.8
    assert rows["median"]["psnr_vs_truth_db"] > rows["none"]["psnr_vs_truth_db"] + 0.5
    assert rows["none"]["mse_vs_unfiltered_dn2"] == 0.0
    assert rows["none"]["psnr_vs_unfiltered_db"] is None, "infinity, which JSON does not know"
    assert rows["none"]["psnr_vs_temporal_mean_db"] is None
    assert made["references"]["temporal_mean"].startswith("none: ")
    assert "as in the paper" in made["references"]["unfiltered"]


def test_real_frames_without_repeats_say_so_in_each_column(lab: Inside) -> None:
    done = lab("report", "denoise", "real", "--recipe", "paper")
    head, none, gaussian, median, *_ = done.stdout.splitlines()
    assert "psnr_vs_unfiltered_db" in head
    assert "psnr_vs_truth_db" in head
    assert none.split()[:2] == ["none", "inf"]
    assert gaussian.count("no truth") == gaussian.count("no repeats") == 2
    assert float(median.split()[1]) > float(gaussian.split()[1]) > 40
    assert "vs_truth: none: " in done.stderr
    assert "peak 255 DN" in done.stderr


def test_frames_at_one_pose_are_judged_by_the_mean_of_the_others(lab: Inside) -> None:
    made = lab.json("report", "denoise", "still")
    rows = {r["filter"]: r for r in made["rows"]}
    assert made["frames"] == 2
    # Noise 4 + rounding 1/12, and a fifth of that from the mean of the other five.
    assert rows["none"]["mse_vs_temporal_mean_dn2"] == pytest.approx((4 + 1 / 12) * 1.2, rel=0.05)
    assert rows["median"]["mse_vs_temporal_mean_dn2"] < 0.6 * rows["none"]["mse_vs_temporal_mean_dn2"]
    assert "5 or more" in made["references"]["temporal_mean"]


def test_the_number_of_frames_and_csv(lab: Inside) -> None:
    assert lab.json("report", "denoise", "simulated", "--frames", "2")["frames"] == 2
    text = lab("report", "denoise", "simulated", "--format", "csv").stdout
    assert [r["filter"] for r in csv.DictReader(text.splitlines())] == FILTERS


def test_16_bit_frames_have_a_peak_of_65535(lab: Inside, tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "deep", 2)
    for path in folder.iterdir():
        frame = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert frame is not None
        assert cv2.imwrite(str(path), frame.astype(np.uint16) * 257)
    lab("import", "images", folder, "--step-deg", "1", "--rig", "r", "--label", "deep")
    assert lab.json("report", "denoise", "deep")["peak_dn"] == 65535.0


def test_the_page_holds_the_table(lab: Inside, tmp_path: Path) -> None:
    page = tmp_path / "denoise.html"
    lab("report", "denoise", "simulated", "-o", page)
    text = page.read_text()
    assert text.count("<tr>") == 2 + len(FILTERS)
    assert "∞" in text
    assert "unfiltered (the paper&#x27;s)" in text
    assert "exists already" in lab.fails("report", "denoise", "simulated", "-o", page)
    lab("report", "denoise", "real", "-o", page, "--overwrite")
    assert "the scan carries no truth" in page.read_text()


def test_what_cannot_be_done_is_said(lab: Inside, tmp_path: Path) -> None:
    assert "cannot write a page as '.pdf'" in lab.fails(
        "report", "denoise", "real", "-o", "x.pdf", code=2
    )
    assert "cannot write" in lab.fails("report", "denoise", "real", "-o", tmp_path / "no" / "x.html")
    assert "nothing" in lab.fails("report", "denoise", "nothing")
    lab.fails("report", "denoise", "real", "--frames", "0", code=2)


def test_a_scan_of_dark_frames_alone(lab: Inside) -> None:
    assert lab.archive is not None
    archive = Archive.open(lab.archive)
    with archive.new_scan() as draft:
        with LogWriter(draft.part) as writer:
            start = {"scan": draft.scan, "rig": "r", "label": "dark", "source": "test"}
            writer.write_event(ScanStart(t_ns=1, **start, time_source="given", software="test"))
            writer.write_event(TurntableAngle(t_ns=1, commanded_rad=0.0))
            exposure = Exposure(t_ns=2, frame=0, lasers_on=())
            ok, data = cv2.imencode(".png", np.zeros((8, 9), np.uint8))
            assert ok
            writer.write_image(exposure, data=data.tobytes(), encoding="png")
            writer.write_event(ScanEnd(t_ns=3, ended="complete", frames=1))
        archive.seal(draft, draft.examine())
    assert "no frame with a laser lit" in lab.fails("report", "denoise", "dark")


def test_it_runs_as_a_command(lab: Inside) -> None:
    done = Console(lab.cwd, lab.archive)("report", "denoise", "real", "--json")
    assert '"filter": "median"' in done.stdout
