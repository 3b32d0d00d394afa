"""Evidence of images about poses: background, observation, optical flow, likelihood."""
