"""Images and ground truth maps of the world: `renderer` makes the image of one camera with the other parts."""
