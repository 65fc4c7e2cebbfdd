"""Names of the models, formats, engines and commands of the workshop, as `bevcli.registered` has those of the core."""

from bevcli.registered import Group

OWN: dict[Group, dict[str, str]] = {
    "bevcli.models": {
        "BEVFormerV2": "bevcli.workshop.bevformer_v2.bevformer_v2:BEVFormerV2",
        "UniAD": "bevcli.workshop.uniad.uniad:UniAD",
        "VAD": "bevcli.workshop.vad.vad:VAD",
    },
    "bevcli.results": {
        "map_lines": "bevcli.workshop.formats.map_lines:MapLines",
        "plan": "bevcli.workshop.vad.plan:Plan",
    },
    # By the format of a drive, and the file or folder that has them: `bevcli.sequences.format.true_results`.
    "bevcli.true_results": {
        "native/ground_truth_lines.json": "bevcli.workshop.formats.map_lines:TrueLines",
        "nuscenes/maps/expansion": "bevcli.workshop.formats.map_lines:MapExpansion",
    },
    "bevcli.sequences": {
        "argoverse2": "bevcli.workshop.formats:ARGOVERSE2",
        "dgp": "bevcli.workshop.formats:DGP",
        "ros": "bevcli.workshop.formats:ROS",
        "t4": "bevcli.workshop.formats:T4",
        "video": "bevcli.workshop.formats:VIDEO",
    },
    "bevcli.calibrations": {
        "files": "bevcli.workshop.formats.calibrations:read_rig",
    },
    "bevcli.poses": {
        "files": "bevcli.workshop.formats.poses:read_poses",
    },
    "bevcli.motion": {
        "drive": "bevcli.workshop.odometry.drives:with_measured_motion",
        "live": "bevcli.workshop.odometry.measure:LiveMotion",
    },
    "bevcli.drive_writers": {
        "mcap": "bevcli.workshop.formats.mcap_writer:OUTPUT",
        "native": "bevcli.workshop.formats.output:NATIVE",
        "nuscenes": "bevcli.workshop.formats.nuscenes_writer:OUTPUT",
    },
    "bevcli.box_formats": {
        "csv": "bevcli.workshop.formats.export:CSV",
        "json": "bevcli.workshop.formats.export:JSON",
        "nuscenes": "bevcli.workshop.formats.export:DETECTION",
        "nuscenes-tracking": "bevcli.workshop.formats.export:TRACKING",
        "kitti": "bevcli.workshop.formats.kitti:BOXES",
    },
    "bevcli.label_formats": {
        "csv": "bevcli.workshop.formats.labels:CSV",
        "cvat": "bevcli.workshop.formats.kitti:CVAT",
        "kitti": "bevcli.workshop.formats.kitti:LABELS",
        "kitti-raw": "bevcli.workshop.formats.kitti:TRACKLETS",
    },
    "bevcli.comparisons": {
        "rigs": "bevcli.workshop.trust.gap_option:gap_of_rigs",
    },
    "bevcli.engines": {
        "onnxruntime": "bevcli.workshop.engines.engine:OnnxRuntimeEngine",
        "openvino": "bevcli.workshop.engines.engine:OpenVinoEngine",
    },
    # A function of a model's name after "hf:": see `bevcli.published.hub_model`.
    "bevcli.hubs": {
        "hf": "bevcli.workshop.hub.download:open_model",
    },
    "bevcli.packings": {
        "hf": "bevcli.workshop.hub.pack:pack_model",
    },
    "bevcli.commands": {
        "batch": "bevcli.workshop.batch.commands:batch",
        "bench": "bevcli.workshop.benchmark.commands:bench",
        "calibrate": "bevcli.workshop.calibration.commands:calibrate",
        "checks": "bevcli.workshop.checks.commands:checks",
        "convert": "bevcli.workshop.formats.commands:convert",
        "demo": "bevcli.workshop.synth.commands:demo",
        "eval": "bevcli.workshop.scores.commands:evaluate",
        "export": "bevcli.workshop.formats.commands:export",
        "export-onnx": "bevcli.workshop.engines.commands:export_onnx",
        "odometry": "bevcli.workshop.odometry.commands:odometry",
        "quantize": "bevcli.workshop.engines.commands:quantize",
        "render": "bevcli.workshop.synth.commands:render",
        "reproduce": "bevcli.workshop.batch.commands:reproduce",
        "stress": "bevcli.workshop.robustness.commands:stress",
        "train": "bevcli.workshop.training.commands:train",
        "validate": "bevcli.workshop.training.commands:validate",
    },
}
