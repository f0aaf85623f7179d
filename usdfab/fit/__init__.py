"""From a photo to a fabric."""
