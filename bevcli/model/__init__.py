"""Models in plain PyTorch, one folder a model, one block of the papers a file.

A model is a subclass of `TemporalModel` (`temporal_model.py`). A package registers it by an entry point, and a TOML
file names it by `architecture`:

    [project.entry-points."bevcli.models"]
    MyModel = "my_package.my_model:MyModel"

It has:

    config_class    its configuration, `ModelConfig` or a subclass with `architecture = "MyModel"`
    step            one frame: (prepared frame, memory) -> (outputs, memory); the memory is any frozen dataclass
    restarted       the part of a memory that is kept where the history starts anew; by default nothing
    decode_boxes    boxes from the outputs; by default from class logits and box codes, as BEVFormer's
    decode_map      a map from the outputs; by default that of the segmentation head
    decode_results  further results, such as lines of the map and a planned path; by default none

and, where it wants them: `exchange_parts` (for `prepare_for_inference`), `export_form`, `official_names` and
`without_training_parts` (of a released weights file), `part_names`, `stages`. The configuration says what the model
needs of a sequence (`past_frames`, `later_frames`, `uses_history`), whether it `has_tracks`, and by `check_training`
whether it can be trained. A subclass of `Network` (`network.py`) has the paper's parts; it can be trained and timed,
and its attentions can be shown. Its `head_losses` are those of heads that make further results.
"""
