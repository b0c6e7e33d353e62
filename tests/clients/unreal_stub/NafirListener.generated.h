// Written by the engine's own tool where there is one.
