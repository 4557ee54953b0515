//! Changes the buffers of Gaussians in ways that [`Splats::new`] refuses.

use subsplat::scene::splats::SplatParts;
use subsplat::scene::splats::Splats;

/// Changes to the buffers of Gaussians.
pub trait Edit {
    /// Applies `change` to the buffers. Their lengths must fit one another afterwards; their
    /// numbers may be anything.
    fn edit(&mut self, change: impl FnOnce(&mut SplatParts));
}

impl Edit for Splats {
    fn edit(&mut self, change: impl FnOnce(&mut SplatParts)) {
        let mut parts = self.clone().into_parts();
        change(&mut parts);
        *self = Self::with_unchecked_numbers(parts).unwrap();
    }
}
