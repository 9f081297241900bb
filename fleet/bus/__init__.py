"""The bus: keys, messages and the exchange. Zenoh lives in `session` and nowhere else."""
