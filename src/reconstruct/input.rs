//! Conversion of photos to the views that a model sees: each photo at the training size, or several views of a larger photo (spec 9.8).

use crate::data::{View, polyphase};
use crate::error::{Error, Result};
use crate::scene::ImageSize;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// Maximum length of a side in pixels.
const MOST: u32 = 16_384;

/// Conversion of a photo that has `phase` times as many rows and columns as the images that a model was trained with.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HighResMode {
    /// Phase² views of the training size, which divide the pixels of the photo among themselves.
    #[default]
    Polyphase,
    /// One view, larger than any in training.
    Whole,
    /// The photo at the training size, repeated phase² times: as many image tokens as with [`HighResMode::Polyphase`], without new information.
    Repeated,
}

impl FromStr for HighResMode {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let all = [HighResMode::Polyphase, HighResMode::Whole, HighResMode::Repeated];
        let named = all.into_iter().find(|views_as| views_as.to_string() == text);
        named.ok_or_else(|| Error::request("expected polyphase, whole or repeated"))
    }
}

impl fmt::Display for HighResMode {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            HighResMode::Polyphase => "polyphase",
            HighResMode::Whole => "whole",
            HighResMode::Repeated => "repeated",
        })
    }
}

/// Conversion of photos to the views that a model sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Input {
    phase: u32,
    views_as: HighResMode,
}

impl Input {
    /// Conversion of each photo to one view, as in training.
    pub const PLAIN: Self = Input { phase: 1, views_as: HighResMode::Polyphase };

    /// Creates the conversion of photos that are `height` pixels high, for a model that was trained with `trained`.
    ///
    /// # Errors
    /// Fails if the height isn't a multiple of the model's, or if a side would be longer than 16,384 pixels.
    pub fn at(height: u32, views_as: HighResMode, trained: ImageSize) -> Result<Self> {
        let side = trained.height;
        let phase = height / side.max(1);
        let longest = u64::from(phase) * u64::from(side.max(trained.width));
        if phase == 0 || phase * side != height || longest > MOST.into() {
            let [twice, thrice] = [2, 3].map(|times| u64::from(side) * times);
            let expected = format!(
                "a multiple of the {side} pixels that the model sees, with sides of {MOST} at most: {side}, {twice}, {thrice}, …"
            );
            return Err(Error::setting("the height of the photos", height, expected));
        }
        Ok(if phase == 1 { Input::PLAIN } else { Input { phase, views_as } })
    }

    /// Returns `true` if each photo becomes one view, as in training.
    pub fn is_plain(&self) -> bool {
        *self == Input::PLAIN
    }

    /// Returns the way in which a photo becomes views.
    pub fn views_as(&self) -> HighResMode {
        self.views_as
    }

    /// Returns the size that photos must have for a model that was trained with `trained`.
    pub fn photo_size(&self, trained: ImageSize) -> ImageSize {
        match self.views_as {
            HighResMode::Polyphase | HighResMode::Whole => {
                ImageSize { height: trained.height * self.phase, width: trained.width * self.phase }
            }
            HighResMode::Repeated => trained,
        }
    }

    /// Returns the number of views that a photo becomes.
    pub fn views_of_photo(&self) -> usize {
        match self.views_as {
            HighResMode::Polyphase | HighResMode::Repeated => (self.phase * self.phase) as usize,
            HighResMode::Whole => 1,
        }
    }

    /// Converts `photo`, which has the size that [`Input::photo_size`] returns, to views.
    ///
    /// # Errors
    /// Fails if the photo has another size that can't be divided.
    pub fn views(&self, photo: &View) -> Result<Vec<View>> {
        match self.views_as {
            HighResMode::Polyphase => polyphase(photo, self.phase),
            HighResMode::Whole | HighResMode::Repeated => {
                Ok((0..self.views_of_photo()).map(|_| photo.shallow_clone()).collect())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heights_are_multiples_of_the_model_s() {
        let trained = ImageSize { height: 32, width: 48 };
        let input = Input::at(96, HighResMode::Polyphase, trained).unwrap();
        assert_eq!((input.photo_size(trained), input.views_of_photo()), ([96, 144].into(), 9));
        let whole = Input::at(96, HighResMode::Whole, trained).unwrap();
        assert_eq!((whole.photo_size(trained), whole.views_of_photo()), ([96, 144].into(), 1));
        let repeated = Input::at(96, HighResMode::Repeated, trained).unwrap();
        assert_eq!((repeated.photo_size(trained), repeated.views_of_photo()), (trained, 9));
        // At the training size, every choice gives the plain conversion.
        assert!(Input::at(32, HighResMode::Whole, trained).unwrap().is_plain());
        for height in [0, 16, 48, 97, 12_288, u32::MAX] {
            let error = Input::at(height, HighResMode::Polyphase, trained).unwrap_err().to_string();
            assert!(
                error.starts_with(&format!(
                    "the height of the photos is {height}, expected a multiple of the 32"
                )),
                "{error}"
            );
            assert!(error.ends_with("32, 64, 96, …"), "{error}");
        }
    }

    #[test]
    fn names_are_read_and_written() {
        for views_as in [HighResMode::Polyphase, HighResMode::Whole, HighResMode::Repeated] {
            assert_eq!(views_as.to_string().parse::<HighResMode>().unwrap(), views_as);
        }
        assert!("half".parse::<HighResMode>().is_err());
    }
}
