"""Files: configurations, tensors, file formats, and safe reading of external files."""
