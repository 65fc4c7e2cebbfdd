"""From a Sequence to Predictions.

load           `load_model`: configuration, weights, device
preprocess     Frame -> images and projections as the network takes them
runner         one step: state in, state and prediction out
background     frames are prepared ahead and written behind
run            the loop: `run` yields predictions
tracking       boxes get identities over time
training_rigs  a rig next to those that the weights were trained on
attention      sampling points of the attentions, as image points
"""
