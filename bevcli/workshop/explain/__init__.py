"""BEVFormer explained: figures of what each step of the model does with one frame."""
