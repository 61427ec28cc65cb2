"""Released models: downloaded from a model hub, checked, and exported if no ONNX networks are published."""
