"""How samples lie in the binary blocks of a stream: one module an encoding, and a registry of them."""
