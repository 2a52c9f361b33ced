"""Policy files and their export."""
