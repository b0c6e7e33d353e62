"""Making listening tests: music in places that training never saw, heard through every method, equally loud."""
