"""What an image says about a pose: silhouette, edges, motion, likelihood terms, the renderer."""
