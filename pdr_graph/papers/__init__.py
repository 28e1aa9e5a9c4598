"""Published methods that only experiments use: the product imports nothing from here."""
