"""The `twin` commands: train, score, judge and use the digital twin of an arm."""
