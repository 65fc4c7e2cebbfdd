"""Other programs that compute the model: export to ONNX, ONNX Runtime and OpenVINO in the place of PyTorch, INT8."""
