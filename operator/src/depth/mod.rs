//! A hand from depth frames: a camera, the hand in its frames, and recordings as folders of 16-bit PNG.
//!
//! What the source publication does with its Kinect: the nearest thing that a person holds out is the hand, and its centroid
//! is what is followed. `docs/input.md` has what came of it on real recordings.

mod camera;
mod find;
mod folder;

pub use camera::{Camera, CameraError, Intrinsics, Size};
pub use find::{Finder, Found};
pub use folder::{Folder, FolderError, decode};
