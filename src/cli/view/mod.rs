//! `globalsplat view`: shows a splat in a browser.

mod contents;
mod page;

pub use page::{check_writable, has_viewer, write_page};

use super::{Output, open_capture, warn};
use crate::error::Error;
use crate::io::read_splat;
use crate::scene::Gaussians;
use anyhow::Result;
use clap::Args;
use serde_json::json;
use std::fs::DirEntry;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Explore a splat interactively: writes a page for a browser, with everything in one file, and opens it.
///
/// With --scene the page includes the capture's photos: it shows them at their camera positions, jumps to them, and compares
/// them with the splat. The page is in the temporary folder, readable only by the current user, until the next `view` removes it;
/// `render --html` writes a permanent one.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat view room.ply --scene captures/room\n  \
    globalsplat render --splat room.ply --scene captures/room --html room.html")]
pub struct View {
    /// Splat: .ply, .compressed.ply, .sog, meta.json, .spz, .splat, .glb, .gltf, .ksplat or .zip
    #[arg(value_name = "SPLAT")]
    splat: PathBuf,
    /// Capture that the splat was made from
    #[arg(long, value_name = "PATH")]
    scene: Option<PathBuf>,
}

impl View {
    pub fn run(self) -> Result<Output> {
        check_writable(None)?;
        let capture = self.scene.as_deref().map(open_capture).transpose()?;
        let splat = read_splat(&self.splat)?;
        warn(&splat.warnings);
        let name = name_of(&self.splat);
        let folder = std::env::temp_dir();
        remove_pages(&folder);
        // `tempfile` makes the page readable only by its owner. The page is kept, because the browser may read it after this program exits.
        let page = tempfile::Builder::new().prefix("page-").suffix(PAGE_ENDING).tempfile_in(&folder);
        let page = page.map_err(|e| {
            let e = Error::write(&folder)(e);
            Error::request(format!("{e}; TMPDIR names another folder for the page, as does `render --html`"))
        })?;
        write_page(page.path(), &name, &Gaussians::from_splat(&splat), splat.origin, capture.as_ref())?;
        let page = page.into_temp_path().keep().map_err(|e| Error::write(e.path.to_path_buf())(e.error))?;
        let opened = open::that_detached(&page);
        if let Err(e) = &opened {
            eprintln!("no browser could be started ({e}): open the page in one, here or elsewhere");
        }
        let page = page.to_string_lossy();
        let json = json!({ "page": page, "gaussians": splat.len(), "opened": opened.is_ok() });
        Ok(Output::new(json, page))
    }
}

/// Suffix of a page's file name, by which a later `view` recognizes the page.
const PAGE_ENDING: &str = ".globalsplat-view.html";

/// Removes the pages that earlier runs of `view` by the current user left in `folder`. Errors are ignored.
fn remove_pages(folder: &Path) {
    for file in folder.read_dir().into_iter().flatten().flatten() {
        if file.file_name().to_string_lossy().ends_with(PAGE_ENDING) && is_own(&file) {
            let _ = std::fs::remove_file(file.path());
        }
    }
}

/// Returns `true` if `file` is a regular file that belongs to the current user.
fn is_own(file: &DirEntry) -> bool {
    // SAFETY: `geteuid` takes no arguments and always succeeds.
    file.metadata().is_ok_and(|file| file.is_file() && file.uid() == unsafe { libc::geteuid() })
}

/// Returns the title of a page for the file at `path`: the file's name without its extension.
pub fn name_of(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}
