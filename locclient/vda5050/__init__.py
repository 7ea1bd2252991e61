"""Localization part of VDA 5050 3.0.0 for a robot under a fleet manager. Imports paho-mqtt only when it connects."""
