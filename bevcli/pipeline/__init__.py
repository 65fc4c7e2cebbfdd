"""From a Sequence to Predictions.

model_loading       `load_model`: configuration, weights, device
preprocess          Frame -> images and projections as the network takes them
camera_assignment   which camera embedding each camera of a rig takes
training_rigs       a rig next to those that the weights were trained on
model_inputs        preprocessed frames -> inputs of one step
temporal            what BEVFormer, BEVFormerV2 and UniAD remember from frame to frame
runner              one step: state in, state and prediction out
run                 the loop: `run` yields predictions, `run_into_folder` also writes them
run_folder          the output folder: lock, and the list of what runs wrote
run_files           the files of a run; run_summary: summary.json; bev_files: BEV features
run_state           the state for --resume; state_file: how it is stored
medians             running medians for summary.json
attention           sampling points of the attentions, as image points
stage_clock         seconds per stage
read_ahead          frames prepared in the background
"""
