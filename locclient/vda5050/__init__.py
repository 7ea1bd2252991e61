"""The localization part of a robot under a fleet manager that speaks VDA 5050 3.0.0. Imports paho-mqtt only when it connects."""
