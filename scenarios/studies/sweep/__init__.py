"""What the choices of a twin change, measured on several arms: configurations, amounts of data."""
