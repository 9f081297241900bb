"""Live fleets: allocation, recording, replay, watch screen, HTTP."""
