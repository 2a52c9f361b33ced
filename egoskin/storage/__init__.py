"""Files: configurations, tensors, their formats, and reading what others have made."""
