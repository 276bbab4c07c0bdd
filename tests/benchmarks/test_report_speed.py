"""The page of a thousand scenes in a browser: its size, how long it takes to make and to open, and its looks.

It takes Chromium (``PREDMAPNET_CHROMIUM``, or ``chromium`` in the path) and the package playwright, which drives it.
``PREDMAPNET_REPORT_SCENES`` sets another number of scenes, ``PREDMAPNET_REPORT_PICTURES`` a folder for screenshots.
"""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely

from mapfusion import ElementKind, GlobalMap
from mapfusion.formats.by_suffix import write_map
from mapfusion.formats.local_plane import LocalPlane
from predmapnet.runs.batch_records import Outcome, write_done, write_failed
from predmapnet.runs.fleet_report import folder_report
from predmapnet.runs.output_folder import OutputFolder
from tests.benchmarks.test_merge_city import city, drive

pytestmark = pytest.mark.benchmark_only

SECONDS = 3.0
"""Within which the map is drawn; the processor has at most half of it to do."""
TOWNS = {"karlsruhe": LocalPlane(8.4, 49.0), "munich": LocalPlane(11.5, 48.1)}


def write_fleet(folder: OutputFolder, count: int) -> None:
    """Write what a batch leaves: maps of drives through two cities, with figures, and three failures."""
    assert folder.path is not None
    rng = np.random.default_rng(0)
    blocks = max(2, round(np.sqrt(count / 2.5)))
    truth = city(blocks)
    tree = shapely.STRtree([shapely.LineString(element.points) for element in truth])
    for number in range(count):
        name, town = f"scene-{number:04d}", "munich" if number % 8 == 0 else "karlsruhe"
        seen = drive(truth, tree, blocks, rng)
        elements = tuple(
            replace(
                element,
                deviation=np.full(len(element.points), rng.gamma(8, 0.03)),
                confidence=float(1 - min(0.5, rng.gamma(1.2, 0.03))),
                observations=int(rng.integers(2, 40)),
            )
            for element in seen
        )
        found = GlobalMap(elements)
        write_map(found, folder.path / f"{name}.geojson", TOWNS[town], {"location": town, "dataset": "a grid"})
        report = {
            "elements": {kind.label: len(found.of_kind(kind)) for kind in ElementKind},
            "metres": {kind.label: found.length(kind) for kind in ElementKind},
            "frames": 40,
            "seconds": float(rng.gamma(20, 0.4)),
            "frames_per_second": float(rng.gamma(30, 0.16)),
            "rejections": {"pose jump": int(rng.integers(1, 5))} if rng.random() < 0.1 else {},
            "accuracy": {"mean_ap": rng.beta(12, 8), "precision": rng.beta(30, 4), "recall": rng.beta(20, 7)},
            "notes": [],
        }
        write_done(folder, name, "", 9.0, report)
    for number, (error, reason) in enumerate(
        [
            ("UserError", "samples/CAM_FRONT/1532402927612460.jpg is cut short"),
            ("TimeLimitError", "it did not end within 600 s, 3 times"),
            ("KeyError", "'ego_pose'"),
        ]
    ):
        write_failed(folder, Outcome(f"scene-9{number:03d}", "failed", 3.0, error=error, reason=reason))


def test_a_thousand_scenes_open_quickly(tmp_path, capsys):
    driver = pytest.importorskip("playwright.sync_api")
    chromium = os.environ.get("PREDMAPNET_CHROMIUM") or shutil.which("chromium")
    if chromium is None:
        pytest.skip("there is no Chromium")
    count = int(os.environ.get("PREDMAPNET_REPORT_SCENES", "1000"))
    write_fleet(OutputFolder(str(tmp_path)), count)
    start = time.perf_counter()
    page_file = tmp_path / "report.html"
    page_file.write_text(folder_report(OutputFolder(str(tmp_path))))
    made = time.perf_counter() - start
    with driver.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1440, "height": 1000})
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        requests: list[str] = []
        page.on("request", lambda request: requests.append(request.url))
        client = page.context.new_cdp_session(page)
        client.send("Performance.enable", {"timeDomain": "threadTicks"})
        page.goto(page_file.as_uri())
        page.wait_for_selector("body[data-drawn][data-complete]")
        whole = page.evaluate("performance.now()") / 1000
        drawn = float(page.evaluate("document.body.dataset.drawn")) / 1000
        metrics = {entry["name"]: entry["value"] for entry in client.send("Performance.getMetrics")["metrics"]}
        pictures = os.environ.get("PREDMAPNET_REPORT_PICTURES")
        save = (lambda name: page.screenshot(path=Path(pictures) / name)) if pictures else (lambda name: None)
        page.wait_for_timeout(200)
        save("overview.png")
        redraw = page.evaluate(
            "(async () => { const c = document.querySelector('.sheet canvas'), t = performance.now();"
            "for (let i = 0; i < 5; i++) { c.dispatchEvent(new WheelEvent('wheel', { deltaY: i % 2 ? 40 : -40,"
            "clientX: 500, clientY: 600 })); await new Promise(requestAnimationFrame); }"
            "return (performance.now() - t) / 5; })()"
        )
        page.click(".doubts li >> nth=0")
        page.wait_for_timeout(700)
        save("doubt.png")
        page.click("[data-act=all]")
        page.click("[data-mode=confidence]")
        page.wait_for_timeout(700)
        save("confidence.png")
        page.click("th:has-text('mAP')")
        page.wait_for_timeout(200)
        values = page.evaluate(
            "[...document.querySelectorAll('#scenes tbody tr')].map((r) => r.cells[8].dataset.value)"
        )
        page.evaluate("document.querySelector('h2').scrollIntoView()")
        save("tables.png")
        browser.close()
    known = [float(value) for value in values if value]
    with capsys.disabled():
        print(
            f"\n{count} scenes: {page_file.stat().st_size / 2**20:.1f} MB, made in {made:.1f} s, drawn {drawn:.2f} s "
            f"and whole {whole:.2f} s after the page began, {metrics['ProcessTime']:.2f} CPU s of the renderer; "
            f"a wheel step {redraw:.0f} ms; load of the machine {os.getloadavg()[0]:.1f}"
        )
    assert not errors
    assert len([url for url in requests if not url.startswith(("file:", "blob:", "data:"))]) == 0
    assert known == sorted(known, reverse=True)
    assert len(known) == count
    assert drawn < SECONDS
    assert metrics["ProcessTime"] < SECONDS / 2
