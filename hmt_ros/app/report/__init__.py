"""The command `report`, which shows the content of a bag as figures and one HTML page."""
