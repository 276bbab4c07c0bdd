"""Opens a map with QGIS's own library, edits it as a person does, saves it, and prints what it saw.

Run by the Python that Debian's package python3-qgis belongs to.
"""

import json
import os
import sys
from pathlib import Path

os.environ["QT_QPA_PLATFORM"] = "offscreen"
from qgis.core import (
    QgsApplication,
    QgsCoordinateTransformContext,
    QgsFeature,
    QgsGeometry,
    QgsPointXY,
    QgsVectorFileWriter,
    QgsVectorLayer,
)

path, out = Path(sys.argv[1]), Path(sys.argv[2])
application = QgsApplication([], False)
application.initQgis()
source = f"{path}|layername=lines" if path.suffix == ".gpkg" else f"{path}|geometrytype=LineString"
layer = QgsVectorLayer(source, "lines", "ogr")
assert layer.isValid(), path
seen = {
    "features": layer.featureCount(),
    "crs": layer.crs().authid(),
    "types": {field.name(): field.typeName() for field in layer.fields()},
    "categories": [c.value() for c in layer.renderer().categories()]
    if layer.renderer().type() == "categorizedSymbol"
    else [],
    "heights": [vertex.z() for feature in layer.getFeatures() for vertex in feature.geometry().vertices()],
}
layer.startEditing()
for feature in list(layer.getFeatures()):
    if feature["id"] == "gone":
        layer.deleteFeature(feature.id())
    if feature["id"] == "kerb":
        vertex = feature.geometry().vertexAt(1)
        layer.moveVertex(vertex.x(), vertex.y() + 4.0 / 111_000.0, feature.id(), 1)
drawn = QgsFeature(layer.fields())
drawn.setGeometry(QgsGeometry.fromPolylineXY([QgsPointXY(*point) for point in json.loads(sys.argv[3])]))
drawn["kind"] = "divider"
layer.addFeature(drawn)
assert layer.commitChanges(), layer.commitErrors()
if path != out:
    options = QgsVectorFileWriter.SaveVectorOptions()
    options.driverName = {".geojson": "GeoJSON", ".fgb": "FlatGeobuf"}[out.suffix]
    error = QgsVectorFileWriter.writeAsVectorFormatV3(layer, str(out), QgsCoordinateTransformContext(), options)
    assert error[0] == QgsVectorFileWriter.NoError, error
print(json.dumps(seen), flush=True)
os._exit(0)  # QGIS may crash when Python takes its objects down
