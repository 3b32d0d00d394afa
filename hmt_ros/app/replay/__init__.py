"""The command `replay`: passes bags to filter, smoother and BME, offline or as live nodes."""
