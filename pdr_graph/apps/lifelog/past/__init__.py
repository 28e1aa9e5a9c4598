"""The past of a person, imported from the exports of other programs: one module per format."""
