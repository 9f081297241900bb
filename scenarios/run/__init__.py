"""Run, compare and record shifts; train policies."""
