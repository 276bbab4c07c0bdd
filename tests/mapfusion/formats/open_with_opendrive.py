"""Opens an OpenDRIVE file with pyxodr and checks it with ASAM's quality checker; prints what they say."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

from pyxodr.road_objects.network import RoadNetwork

path = Path(sys.argv[1])
roads = RoadNetwork(str(path)).get_roads()
with tempfile.TemporaryDirectory() as folder:
    configuration, result = Path(folder) / "configuration.xml", Path(folder) / "result.xqar"
    configuration.write_text(
        f'<Config><Param name="InputFile" value="{path}"/><CheckerBundle application="xodrBundle">'
        f'<Param name="resultFile" value="{result}"/></CheckerBundle></Config>'
    )
    checker = Path(sys.executable).with_name("qc_opendrive")
    subprocess.run([checker, "-c", configuration], check=True, capture_output=True)
    report = ElementTree.parse(result).getroot()
checks = {checker.attrib["checkerId"]: checker.attrib["status"] for checker in report.iter("Checker")}
issues = [
    f"{checker.attrib['checkerId']}: {issue.attrib['description']}"
    for checker in report.iter("Checker")
    for issue in checker.iter("Issue")
]
print(
    json.dumps(
        {
            "lines": {
                road.road_xml.attrib["name"]: [list(road.reference_line[end]) for end in (0, -1)] for road in roads
            },
            "heights": {
                road.road_xml.attrib["name"]: [float(road.z_coordinates[end]) for end in (0, -1)] for road in roads
            },
            "checks": checks,
            "issues": issues,
        }
    )
)
