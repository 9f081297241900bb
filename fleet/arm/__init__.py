"""The Gen3 in MuJoCo: models, plans, space, and the plant that simulates them."""
