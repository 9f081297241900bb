"""Reading logs of real arms."""
