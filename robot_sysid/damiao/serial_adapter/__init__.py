"""The maker's own serial USB-CAN adapter, as an interface for python-can."""
