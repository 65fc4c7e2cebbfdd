"""Training of a BEVFormer: data, losses, the loop and the validation, in plain PyTorch.

In the order of a training step:

    augmentation           changes of the images and of the calibration
    targets                the ground truth boxes and masks of frames
    samples                clips of drives (`bevcli.workshop.synth.drives`) as network inputs, in batches made ahead
    clip_steps             forward passes through clips: of the model, of its frozen stages, of a teacher
    losses                 Hungarian matching, focal, L1 and dice loss of boxes, masks and BEV cells
    frame_losses           all losses of a frame by name, among them BEVFormerV2's detector on the image features
    trainer                the loop: updates of the weights, checkpoints, released weights
    job                    the [training] table of a model file, and the model, drives and processes of a training
    warm_start             weights of another model, or of a backbone for ImageNet, to start from
    model_file             a new model file for a data set
    validation             checks of drives, scores of a model over several drives, and learning curves
"""
