"""What controllers speak: one file a dialect. docs/controllers.md describes them all."""
