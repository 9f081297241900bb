"""Certificates, roles and key permissions for mutual TLS."""
