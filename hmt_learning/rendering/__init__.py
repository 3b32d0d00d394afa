"""Images of the body model: renderer, clothes and scene, for training sets and rendered bags."""
