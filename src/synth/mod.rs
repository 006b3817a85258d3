//! Synthetic scenes and videos of them: unlimited posed photos for training without enough real ones.
//!
//! A scene consists of plain shapes (`shapes`), which form objects (`things`), which are placed in rooms (`room`) and outdoors
//! (`open`). Textures of many families cover them. A [`Video`] views the scene along a path through its free space (`walk`) by ray
//! tracing triangles (`tracer`), and a sensor model converts the light to bytes.

mod gaussian_room;
mod light;
mod maker;
mod material;
mod mesh;
mod noise;
mod open;
mod room;
mod sensor;
mod shapes;
mod texture;
mod things;
mod tracer;
mod tree;
mod video;
mod walk;

pub use gaussian_room::Room;
pub use texture::Texture;
pub use video::{Video, VideoSettings};
