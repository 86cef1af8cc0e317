"""Robots with lidars: in real buildings, in known maps, from starts anywhere, by headers as drivers write them."""
