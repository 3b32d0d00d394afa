"""The command import-video, which writes a video and what was found in it into a bag."""
