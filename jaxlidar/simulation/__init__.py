"""Simulations: of one scene and of many, energy budgets, reflectance factors and true returns."""
