"""A recorded shift in three dimensions: in a page, in MuJoCo's viewer, as a film."""
