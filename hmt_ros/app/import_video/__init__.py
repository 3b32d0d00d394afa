"""The command import-video, which writes a video and the detections in it into a bag."""
