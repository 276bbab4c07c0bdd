"""The metric fixtures: those that come with the project, and the reference named by PREDMAPNET_REFERENCE."""

import pytest

from tests.predmapnet.evaluation.metric_fixtures import BUNDLED, REFERENCE, MetricCase, load_metric_case


@pytest.fixture(
    scope="session",
    params=[pytest.param(BUNDLED, id="bundled"), pytest.param(REFERENCE, id="reference", marks=pytest.mark.reference)],
)
def case(request) -> MetricCase:
    folder = request.param
    if not (folder / "expected.json").exists():
        pytest.skip(f"no metric fixtures in {folder}: set PREDMAPNET_REFERENCE")
    return load_metric_case(folder)
