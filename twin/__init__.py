"""One robot's heat: the LSTM variational autoencoder that scores planned motion."""
