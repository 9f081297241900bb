"""The Zenoh client, its router, and what both need."""
