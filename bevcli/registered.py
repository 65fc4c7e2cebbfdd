"""Names of the models, formats and commands of the core; each is imported when it is used.

The workshop's are in `workshop/registered.py`; packages of others add theirs by entry points (`registry.py`,
docs/extend.md).
"""

from typing import Literal

Group = Literal[
    "bevcli.models",
    "bevcli.results",
    "bevcli.sequences",
    "bevcli.true_results",
    "bevcli.drive_writers",
    "bevcli.box_formats",
    "bevcli.label_formats",
    "bevcli.scores",
    "bevcli.plots",
    "bevcli.engines",
    "bevcli.training_heads",
    "bevcli.commands",
]

# Group -> name -> "module:attribute".
OWN: dict[Group, dict[str, str]] = {
    "bevcli.models": {
        "BEVFormer": "bevcli.model.bevformer.bevformer:BEVFormer",
        "BEVFormerV2": "bevcli.model.bevformer_v2.bevformer_v2:BEVFormerV2",
    },
    "bevcli.results": {},
    "bevcli.sequences": {
        "native": "bevcli.sequences.native.format:FORMAT",
        "nuscenes": "bevcli.sequences.nuscenes.format:FORMAT",
    },
    "bevcli.box_formats": {
        "csv": "bevcli.evaluation.box_format:CSV",
        "json": "bevcli.evaluation.box_format:JSON",
        "nuscenes": "bevcli.evaluation.submission:DETECTION",
        "nuscenes-tracking": "bevcli.evaluation.submission:TRACKING",
    },
    "bevcli.commands": {
        "eval": "bevcli.cli.eval:evaluate",
        "export": "bevcli.cli.export:export",
        "project-debug": "bevcli.cli.project_debug:project_debug",
        "run": "bevcli.cli.run:run",
        "samples": "bevcli.cli.samples:samples",
        "viz": "bevcli.cli.viz:viz",
        "weights": "bevcli.cli.weights:weights_app",
    },
}
