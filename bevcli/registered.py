"""Names of bevcli's own models, formats, engines and commands; each is imported when it is used.

Packages of others add theirs by entry points (`registry.py`, docs/extend.md).
"""

from typing import Literal

Group = Literal[
    "bevcli.models",
    "bevcli.sequences",
    "bevcli.drive_writers",
    "bevcli.box_formats",
    "bevcli.label_formats",
    "bevcli.engines",
    "bevcli.commands",
]

# Group -> name -> "module:attribute".
OWN: dict[Group, dict[str, str]] = {
    "bevcli.models": {
        "BEVFormer": "bevcli.model.bevformer.bevformer:BEVFormer",
        "BEVFormerV2": "bevcli.model.bevformer_v2.bevformer_v2:BEVFormerV2",
        "UniAD": "bevcli.model.uniad.uniad:UniAD",
        "VAD": "bevcli.model.vad.vad:VAD",
    },
    "bevcli.sequences": {
        "argoverse2": "bevcli.sequences.argoverse2.format:FORMAT",
        "dgp": "bevcli.sequences.dgp.format:FORMAT",
        "native": "bevcli.sequences.native.format:FORMAT",
        "nuscenes": "bevcli.sequences.nuscenes.format:FORMAT",
        "ros": "bevcli.sequences.ros.format:FORMAT",
        "t4": "bevcli.sequences.t4.format:FORMAT",
    },
    "bevcli.drive_writers": {
        "mcap": "bevcli.recording.foxglove.format:OUTPUT",
        "native": "bevcli.sequences.native.format:OUTPUT",
        "nuscenes": "bevcli.sequences.nuscenes.format:OUTPUT",
    },
    "bevcli.box_formats": {
        "csv": "bevcli.evaluation.formats.csv_table:FORMAT",
        "json": "bevcli.evaluation.formats.boxes_json:FORMAT",
        "kitti": "bevcli.evaluation.formats.kitti:FORMAT",
        "kitti-raw": "bevcli.evaluation.formats.kitti_raw:FORMAT",
        "nuscenes": "bevcli.evaluation.formats.nuscenes:DETECTION",
        "nuscenes-tracking": "bevcli.evaluation.formats.nuscenes:TRACKING",
        "openlabel": "bevcli.evaluation.formats.openlabel:FORMAT",
    },
    "bevcli.label_formats": {
        "csv": "bevcli.sequences.labels.csv_table:FORMAT",
        "cvat": "bevcli.sequences.labels.cvat:FORMAT",
        "kitti": "bevcli.sequences.labels.kitti:FORMAT",
        "kitti-raw": "bevcli.sequences.labels.kitti_raw:FORMAT",
        "openlabel": "bevcli.sequences.labels.openlabel:FORMAT",
    },
    "bevcli.engines": {
        "onnxruntime": "bevcli.engines.engine:OnnxRuntimeEngine",
        "openvino": "bevcli.engines.engine:OpenVinoEngine",
    },
    "bevcli.commands": {
        "batch": "bevcli.cli.batch:batch",
        "bench": "bevcli.cli.bench:bench",
        "calibrate": "bevcli.cli.calibrate:calibrate",
        "convert": "bevcli.cli.convert:convert",
        "demo": "bevcli.cli.demo:demo",
        "eval": "bevcli.cli.eval:evaluate",
        "explain": "bevcli.cli.explain:explain",
        "export": "bevcli.cli.export:export",
        "export-onnx": "bevcli.cli.export_onnx:export_onnx",
        "find-like": "bevcli.cli.find_like:find_like",
        "project-debug": "bevcli.cli.project_debug:project_debug",
        "quantize": "bevcli.cli.quantize:quantize",
        "render": "bevcli.cli.render:render",
        "reproduce": "bevcli.cli.reproduce:reproduce",
        "run": "bevcli.cli.run:run",
        "samples": "bevcli.cli.samples:samples",
        "stress": "bevcli.cli.stress:stress",
        "train": "bevcli.cli.train:train",
        "validate": "bevcli.cli.validate:validate",
        "viz": "bevcli.cli.viz:viz",
        "weights": "bevcli.cli.weights:weights_app",
    },
}
