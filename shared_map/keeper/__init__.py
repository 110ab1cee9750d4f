"""The keeper: stores every acknowledged mark, compacts what dead authors left, serves the base map."""
