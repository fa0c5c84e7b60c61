"""The droid head: its solids, its unwrap, its paint, and the glTF that holds them."""
