"""Networks from ONNX files: chains of layers with derivatives arranged by hand, other graphs through CasADi."""
