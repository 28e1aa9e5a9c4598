"""The formats of floor plans, one a module. `floor.plan_files` recognises them."""
