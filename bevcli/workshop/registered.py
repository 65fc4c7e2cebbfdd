"""Names of the models, formats, engines and commands of the workshop, as `bevcli.registered` has those of the core."""

from bevcli.registered import Group

OWN: dict[Group, dict[str, str]] = {
    "bevcli.models": {
        "UniAD": "bevcli.workshop.uniad.uniad:UniAD",
        "VAD": "bevcli.workshop.vad.vad:VAD",
    },
    "bevcli.model_uses": {
        "clip_steps BEVFormer": "bevcli.workshop.training.clip_steps:RecurrentSteps",
        "clip_steps BEVFormerV2": "bevcli.workshop.training.window_steps:WindowSteps",
        "constant_parts UniAD": "bevcli.workshop.uniad.uniad:fix_nothing",
        "constant_parts VAD": "bevcli.workshop.vad.vad:fix_first_attentions",
        "export_form BEVFormer": "bevcli.workshop.engines.export_form:RecurrentForm",
        "export_form BEVFormerV2": "bevcli.workshop.engines.window_export:window_form",
        "export_form UniAD": "bevcli.workshop.uniad.uniad:refuse_export",
        "export_form VAD": "bevcli.workshop.vad.export_form:VADForm",
        "head_losses VAD": "bevcli.workshop.vad.losses:head_losses",
        "figures BEVFormer": "bevcli.workshop.explain.overview:FIGURES",
        "figures UniAD": "bevcli.workshop.explain.overview:NO_FIGURES",
        "figures VAD": "bevcli.workshop.explain.attention_figures:ALL_FIGURES",
        "scene_attentions VAD": "bevcli.workshop.vad.scene_attention:scene_attentions",
        "operations BEVFormer": "bevcli.workshop.benchmark.measure:run_recurrent_frame",
        "operations BEVFormerV2": "bevcli.workshop.benchmark.window_frames:run_window",
        "operations UniAD": "bevcli.workshop.uniad.uniad:run_map_head",
        "part_names UniAD": "bevcli.workshop.uniad.uniad:PART_NAMES",
        "part_names VAD": "bevcli.workshop.vad.vad:PART_NAMES",
        "past BEVFormerV2": "bevcli.workshop.benchmark.window_frames:with_past",
    },
    "bevcli.sequences": {
        "argoverse2": "bevcli.workshop.formats.argoverse2.format:FORMAT",
        "dgp": "bevcli.workshop.formats.dgp.format:FORMAT",
        "ros": "bevcli.workshop.formats.ros.format:FORMAT",
        "t4": "bevcli.workshop.formats.t4.format:FORMAT",
    },
    "bevcli.drive_writers": {
        "mcap": "bevcli.workshop.formats.foxglove.format:OUTPUT",
    },
    "bevcli.box_formats": {
        "kitti": "bevcli.workshop.formats.boxes.kitti:FORMAT",
        "kitti-raw": "bevcli.workshop.formats.boxes.kitti_raw:FORMAT",
        "openlabel": "bevcli.workshop.formats.boxes.openlabel:FORMAT",
    },
    "bevcli.label_formats": {
        "csv": "bevcli.workshop.formats.labels.csv_table:FORMAT",
        "cvat": "bevcli.workshop.formats.labels.cvat:FORMAT",
        "kitti": "bevcli.workshop.formats.labels.kitti:FORMAT",
        "kitti-raw": "bevcli.workshop.formats.labels.kitti_raw:FORMAT",
        "openlabel": "bevcli.workshop.formats.labels.openlabel:FORMAT",
    },
    "bevcli.engines": {
        "onnxruntime": "bevcli.workshop.engines.engine:OnnxRuntimeEngine",
        "openvino": "bevcli.workshop.engines.engine:OpenVinoEngine",
    },
    "bevcli.commands": {
        "batch": "bevcli.workshop.batch.command:batch",
        "bench": "bevcli.workshop.benchmark.command:bench",
        "calibrate": "bevcli.workshop.calibration.command:calibrate",
        "convert": "bevcli.workshop.formats.convert_command:convert",
        "demo": "bevcli.workshop.synth.demo_command:demo",
        "explain": "bevcli.workshop.explain.command:explain",
        "export-onnx": "bevcli.workshop.engines.export_command:export_onnx",
        "find-like": "bevcli.workshop.batch.find_like_command:find_like",
        "quantize": "bevcli.workshop.engines.quantize_command:quantize",
        "render": "bevcli.workshop.synth.command:render",
        "reproduce": "bevcli.workshop.batch.reproduce_command:reproduce",
        "stress": "bevcli.workshop.robustness.command:stress",
        "train": "bevcli.workshop.training.train_command:train",
        "validate": "bevcli.workshop.training.validate_command:validate",
    },
    "bevcli.extensions": {
        "project-debug.motion": "bevcli.workshop.calibration.command:CHECK_MOTION",
        "run.calibrate": "bevcli.workshop.calibration.command:CALIBRATE_FIRST",
    },
}
