"""Single files that several formats share: boxes, maps, poses, intrinsics."""
