"""MuJoCo models of the arm and the cell, and the plant that simulates them."""
