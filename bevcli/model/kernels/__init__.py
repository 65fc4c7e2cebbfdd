"""The same operations, faster: backends of deformable attention and convolution, and oneDNN layers."""
