"""The person: link tree, pose, rigged mesh, skinning, distortion score. Both ends build the same mesh here."""
