"""The network as ONNX graphs, and mapping with them."""
