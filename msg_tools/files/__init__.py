"""Files from outside, read safely, and folders written whole; imports nothing of ours."""
