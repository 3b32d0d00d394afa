"""The command `report`: figures and one HTML page of what a bag carries."""
