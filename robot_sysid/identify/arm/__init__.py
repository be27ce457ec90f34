"""Identifying every link of an arm from its logs."""
