use super::{print_json, progress};
use anyhow::Result;
use clap::Args;
use globalsplat::data::write_room;
use globalsplat::error::Error;
use globalsplat::io::check_writable_dir;
use globalsplat::scene::ImageSize;
use serde_json::json;
use std::path::PathBuf;

/// Make captures of procedural rooms, for trying things without photos.
#[derive(Args)]
#[command(after_help = "Example:\n  globalsplat synth --out captures --scenes 2 --seed 1")]
pub struct Synth {
    /// Folder for the captures: room_000, room_001, …
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Number of rooms
    #[arg(long, value_name = "N", default_value_t = 1)]
    scenes: u64,
    /// Other rooms for another seed
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Photos of each
    #[arg(long, value_name = "N", default_value_t = 24)]
    frames: usize,
    /// Side of a photo in pixels
    #[arg(long, value_name = "PIXELS", default_value_t = 256)]
    size: u32,
    /// Print what was written as one JSON object
    #[arg(long)]
    json: bool,
}

impl Synth {
    pub fn run(self) -> Result<()> {
        if self.frames < 2 {
            return Err(Error::Request(format!("--frames is {}, expected 2 or more", self.frames)).into());
        }
        if !(16..=8192).contains(&self.size) {
            return Err(Error::Request(format!("--size is {}, expected 16 to 8192", self.size)).into());
        }
        check_writable_dir(&self.out)?;
        let bar = progress::bar(self.scenes, "scenes");
        let mut captures = vec![];
        for scene in 0..self.scenes {
            let path = self.out.join(format!("room_{scene:03}"));
            let size = ImageSize { height: self.size, width: self.size };
            write_room(&path, self.seed.wrapping_mul(1_000_003).wrapping_add(scene), self.frames, size)?;
            captures.push(path);
            bar.inc(1);
        }
        bar.finish_and_clear();
        if self.json {
            print_json(&json!({ "captures": captures }));
        } else {
            println!("{}: {} captures of {} photos", self.out.display(), captures.len(), self.frames);
        }
        Ok(())
    }
}
