"""Models in plain PyTorch, one folder a model, one block of the papers a file.

A model is a subclass of `TemporalModel` (`temporal_model.py`). A package registers it by an entry point, and a TOML
file names it by `architecture`:

    [project.entry-points."bevcli.models"]
    MyModel = "my_package.my_model:MyModel"

It has a configuration, `ModelConfig` or a subclass with `architecture = "MyModel"`, and a `step`; everything else of
`TemporalModel` and `ModelConfig` has a default. A subclass of `Network` (`network.py`) has the paper's parts: it can be
trained and timed, and its attentions can be shown.
"""

from typing import Literal

Precision = Literal["fp32", "bf16", "fp16"]
"""Of a model in PyTorch."""
AnyPrecision = Literal["fp32", "bf16", "fp16", "int8"]
"""Of a model in any engine: only other engines have INT8."""
