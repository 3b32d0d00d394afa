"""The command `replay`: bags through filter, smoother and BME, offline or through live nodes."""
