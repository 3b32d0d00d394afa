"""The command `report`: figures and one HTML page of the content of a bag."""
