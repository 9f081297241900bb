"""Live fleets: allocation, recording, replay, dashboard, HTTP."""
