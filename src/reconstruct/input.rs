//! Conversion of photos to the views that a model sees: each photo at the training size, or several views of a larger photo (spec 9.8).

use crate::data::{View, polyphase};
use crate::error::{Error, Result};
use crate::scene::ImageSize;
use serde::{Deserialize, Serialize};

/// Maximum length of a side in pixels.
const MAX_SIDE: u32 = 16_384;

/// Conversion of photos to the views that a model sees: a photo with `phase` times as many rows and columns as the images that the model
/// was trained with becomes phase² views of the training size, which divide its pixels among themselves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Input {
    phase: u32,
}

impl Input {
    /// Conversion of each photo to one view, as in training.
    pub const PLAIN: Self = Input { phase: 1 };

    /// Creates the conversion of photos that are `height` pixels high, for a model that was trained with `trained`.
    ///
    /// # Errors
    /// Fails if the height isn't a multiple of the model's, or if a side would be longer than 16,384 pixels.
    pub fn with_height(height: u32, trained: ImageSize) -> Result<Self> {
        let side = trained.height;
        let phase = height / side.max(1);
        let longest = u64::from(phase) * u64::from(side.max(trained.width));
        if phase == 0 || phase * side != height || longest > MAX_SIDE.into() {
            let [twice, thrice] = [2, 3].map(|times| u64::from(side) * times);
            let expected = format!(
                "a multiple of the {side} pixels that the model sees, with sides of {MAX_SIDE} at most: {side}, {twice}, {thrice}, …"
            );
            return Err(Error::setting("--views-at", height, expected));
        }
        Ok(Input { phase })
    }

    /// Returns `true` if each photo becomes one view, as in training.
    pub fn is_plain(&self) -> bool {
        *self == Input::PLAIN
    }

    /// Returns the size that photos must have for a model that was trained with `trained`.
    pub fn photo_size(&self, trained: ImageSize) -> ImageSize {
        ImageSize { height: trained.height * self.phase, width: trained.width * self.phase }
    }

    /// Returns the number of views that a photo becomes.
    pub fn views_of_photo(&self) -> usize {
        (self.phase * self.phase) as usize
    }

    /// Converts `photo`, which has the size that [`Input::photo_size`] returns, to views.
    ///
    /// # Errors
    /// Fails if the photo has another size that can't be divided.
    pub fn views(&self, photo: &View) -> Result<Vec<View>> {
        polyphase(photo, self.phase)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heights_are_multiples_of_the_model_s() {
        let trained = ImageSize { height: 32, width: 48 };
        let input = Input::with_height(96, trained).unwrap();
        assert_eq!((input.photo_size(trained), input.views_of_photo()), ([96, 144].into(), 9));
        assert!(Input::with_height(32, trained).unwrap().is_plain());
        for height in [0, 16, 48, 97, 12_288, u32::MAX] {
            let error = Input::with_height(height, trained).unwrap_err().to_string();
            assert!(
                error.starts_with(&format!("--views-at is {height}, expected a multiple of the 32")),
                "{error}"
            );
            assert!(error.ends_with("32, 64, 96, …"), "{error}");
        }
    }

    #[test]
    fn former_evaluations_are_read() {
        let input: Input = serde_json::from_str(r#"{"phase": 2, "views_as": "polyphase"}"#).unwrap();
        assert_eq!(input, Input { phase: 2 });
    }
}
