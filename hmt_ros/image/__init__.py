"""What an image says about a pose: background, observation, optical flow, likelihood."""
