"""What an image says about a pose: background, observation, texture, likelihood."""
