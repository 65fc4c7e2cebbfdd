"""Training of a BEVFormer: data, losses, the loop and the validation, in plain PyTorch.

In the order of a training step:

    drives                 where the frames come from: sequence folders, or drives rendered from seeds
    clips                  which frames make a training clip
    samples                frames of clips -> network inputs and targets; `augmentation` changes the images
    detection_targets      ground truth boxes -> targets of the detection head
    segmentation_targets   ground truth maps and boxes -> targets of the segmentation head
    hungarian_matching     the one-to-one assignment of queries to ground truth
    detection_loss         focal and L1 loss after each decoder layer
    segmentation_loss      focal, dice and L1 loss after each mask layer; `focal_loss` serves all losses
    dense_loss             auxiliary loss on the BEV map
    perspective_targets    boxes projected into each camera -> targets of the pixels of the feature maps
    perspective_head       BEVFormerV2's detector on the image features, in training only
    perspective_loss       its loss
    frame_losses           all losses of a frame, by name
    clip_forward           the forward passes of a clip, with the earlier frames as history
    optimizer              AdamW and its learning rate schedule
    trainer                the loop: clips in, updates of the weights, checkpoints and curves out
    job                    the [training] table of a model file, and what a training is made from
    checkpoint             resumable checkpoints and released weights
    learning_curves        losses and scores as CSV files and a plot
    validation             scores of a model over several drives
    process_group          several processes that train one model
"""
