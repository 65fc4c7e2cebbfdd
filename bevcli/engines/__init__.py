"""Other programs that compute the model: export to ONNX, and ONNX Runtime in the place of PyTorch."""
