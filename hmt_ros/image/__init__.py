"""Evidence about poses from images: background, observation, optical flow, likelihood."""
