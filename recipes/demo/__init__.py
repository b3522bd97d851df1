"""What a policy does, to look at: figures, a film, a preference changed on the way."""
