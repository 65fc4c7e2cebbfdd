"""Names of the models, formats and commands of the core; each is imported when it is used.

The workshop's are in `workshop/registered.py`; packages of others add theirs by entry points (`registry.py`,
docs/extend.md).
"""

from typing import Literal

Group = Literal[
    "bevcli.models",
    "bevcli.calibrations",
    "bevcli.results",
    "bevcli.sequences",
    "bevcli.poses",
    "bevcli.motion",
    "bevcli.true_results",
    "bevcli.drive_writers",
    "bevcli.box_formats",
    "bevcli.label_formats",
    "bevcli.comparisons",
    "bevcli.plots",
    "bevcli.engines",
    "bevcli.hubs",
    "bevcli.packings",
    "bevcli.commands",
]

# Group -> name -> "module:attribute".
OWN: dict[Group, dict[str, str]] = {
    "bevcli.models": {
        "BEVFormer": "bevcli.model.bevformer.bevformer:BEVFormer",
    },
    "bevcli.results": {},
    "bevcli.sequences": {
        "native": "bevcli.sequences.native:FORMAT",
        "nuscenes": "bevcli.sequences.nuscenes:FORMAT",
    },
    "bevcli.plots": {
        "prediction": "bevcli.viewer.plot:plot",
    },
    "bevcli.commands": {
        "project-debug": "bevcli.cli.commands:project_debug",
        "run": "bevcli.cli.run:run",
        "samples": "bevcli.cli.commands:samples",
        "viz": "bevcli.cli.commands:viz",
        "weights": "bevcli.cli.weights:weights_app",
    },
}
