"""Pictures of an episode: floor plan, temperatures, queue."""
