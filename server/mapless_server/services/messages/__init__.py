"""Between messages and values, for the services: what a request says wrongly is said by its field."""
