"""Training of a BEVFormer: data, losses, the loop and the validation, in plain PyTorch.

In the order of a training step:

    samples                clips drawn from drives (`bevcli.workshop.synth.drives`) -> network inputs and targets
    loading                batches of them, made ahead
    augmentation           changes of the images and of the calibration
    detection_loss         targets from boxes, Hungarian matching, focal and L1 loss after each decoder layer
    segmentation_loss      targets from maps and boxes, focal, dice and L1 loss after each mask layer
    perspective_loss       BEVFormerV2's detector on the image features, in training only, its targets and its loss
    frame_losses           all losses of a frame by name, among them auxiliary ones on the BEV map
    trainer                the loop: forward passes of clips, updates of the weights, checkpoints and curves
    files                  checkpoints, released weights and learning curves
    job                    the [training] table of a model file, and the model, drives and processes of a training
    warm_start             weights of another model, or of a backbone for ImageNet, to start from
    model_file             a new model file for a data set
    validation             checks of drives, and scores of a model over several drives
"""
