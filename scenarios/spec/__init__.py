"""Scenario files: schema, parsing, job streams, and the options of commands."""
