"""The world: laws, nouns, simulator, environment and bus. Imports none of the other packages."""
