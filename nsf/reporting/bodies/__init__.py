"""Pictures of bodies: particles, solids and a camera in, strips and animations out."""
