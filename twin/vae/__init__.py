"""The LSTM variational autoencoder: windows, model, training, scores."""
