"""What a body meets: colliders, the domain's walls, their motion and contact."""
