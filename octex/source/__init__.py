"""Where values come from: model files, their geometry, materials and images, as one coloured surface."""
