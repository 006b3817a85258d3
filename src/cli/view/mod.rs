mod contents;
mod page;

pub use page::{check_writable, has_viewer, write_page};

use super::{open_capture, print_json};
use anyhow::Result;
use clap::Args;
use globalsplat::error::Error;
use globalsplat::io::read_splat;
use serde_json::json;
use std::path::{Path, PathBuf};

/// Walk in a splat: writes a page for a browser, with everything in one file, and opens it.
///
/// With --scene there are the capture's photos, too: to jump to, to see in the places they were taken from, and to compare with. The
/// page stays where it is told to be; `render --html` writes it elsewhere.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat view room.ply --scene captures/room\n  \
    globalsplat render --splat room.ply --scene captures/room --html room.html")]
pub struct View {
    /// A splat: .ply, .compressed.ply, .spz or .splat
    #[arg(value_name = "SPLAT")]
    splat: PathBuf,
    /// The capture that it was made from
    #[arg(long, value_name = "PATH")]
    scene: Option<PathBuf>,
    /// Print where the page is as one JSON object
    #[arg(long)]
    json: bool,
}

impl View {
    pub fn run(self) -> Result<()> {
        page::check_has_viewer()?;
        let capture = self.scene.as_deref().map(open_capture).transpose()?;
        let splat = read_splat(&self.splat)?;
        let name = name_of(&self.splat);
        // The browser reads it when this program is gone.
        let page = tempfile::Builder::new().prefix(&format!("{name}-")).suffix(".html").tempfile()?;
        let (_, page) = page.keep().map_err(|e| Error::write(e.file.path())(e.error))?;
        write_page(&page, &name, &splat, capture.as_ref())?;
        let opened = open::that_detached(&page);
        if self.json {
            print_json(
                &json!({ "page": page, "gaussians": splat.gaussians.count(), "opened": opened.is_ok() }),
            );
        } else {
            println!("{}", page.display());
        }
        if let Err(e) = opened {
            eprintln!("no browser could be started ({e}): open the page in one, here or elsewhere");
        }
        Ok(())
    }
}

/// What a page is called that is about the file at `path`.
pub fn name_of(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}
