//! Made-up worlds and videos taken in them: endless posed photos for where there are none, or too few.
//!
//! A world is made of plain shapes (`shapes`), which make things (`things`), which stand in rooms (`room`) and under the sky
//! (`open`); textures of many families cover them. A [`Video`] looks at it along a path through its free space (`walk`), by
//! rays through triangles (`tracer`), and a sensor makes bytes of that.

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
