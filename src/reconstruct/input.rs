//! What a model sees of a photo: the photo at the size that it was trained with, or what more pixels become (spec 9.8).

use crate::data::{View, polyphase};
use crate::error::{Error, Result};
use crate::scene::ImageSize;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// Of a side, in pixels.
const MOST: u32 = 16_384;

/// What a photo becomes that has `phase` times as many rows and columns as the images that a model was trained with.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ViewsAs {
    /// Phase² views of the size trained with, which share its pixels out among themselves.
    #[default]
    Polyphase,
    /// One view, larger than any in training.
    Whole,
    /// It is made as small as in training, and shown phase² times: as many image tokens as of [`ViewsAs::Polyphase`], and nothing
    /// new in them.
    Repeated,
}

impl FromStr for ViewsAs {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let all = [ViewsAs::Polyphase, ViewsAs::Whole, ViewsAs::Repeated];
        let named = all.into_iter().find(|views_as| views_as.to_string() == text);
        named.ok_or_else(|| Error::Request("expected polyphase, whole or repeated".into()))
    }
}

impl fmt::Display for ViewsAs {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            ViewsAs::Polyphase => "polyphase",
            ViewsAs::Whole => "whole",
            ViewsAs::Repeated => "repeated",
        })
    }
}

/// How photos become what a model sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Input {
    phase: u32,
    views_as: ViewsAs,
}

impl Input {
    /// A photo is a view, as in training.
    pub const PLAIN: Self = Input { phase: 1, views_as: ViewsAs::Polyphase };

    /// Of photos that are `height` pixels high, for a model that was trained with `trained`.
    ///
    /// # Errors
    /// A height that isn't a multiple of the model's.
    pub fn at(height: u32, views_as: ViewsAs, trained: ImageSize) -> Result<Self> {
        let side = trained.height;
        let phase = height / side.max(1);
        let longest = u64::from(phase) * u64::from(side.max(trained.width));
        if phase == 0 || phase * side != height || longest > MOST.into() {
            let [twice, thrice] = [2, 3].map(|times| u64::from(side) * times);
            return Err(Error::Request(format!(
                "--views-at is {height}, expected a multiple of the {side} pixels that the model sees, with sides of {MOST} at \
                 most: {side}, {twice}, {thrice}, …"
            )));
        }
        Ok(if phase == 1 { Input::PLAIN } else { Input { phase, views_as } })
    }

    /// Whether a photo is a view, as in training.
    pub fn is_plain(&self) -> bool {
        *self == Input::PLAIN
    }

    /// How a photo becomes views.
    pub fn views_as(&self) -> ViewsAs {
        self.views_as
    }

    /// What photos have to be fitted to, for a model that was trained with `trained`.
    pub fn photo_size(&self, trained: ImageSize) -> ImageSize {
        match self.views_as {
            ViewsAs::Polyphase | ViewsAs::Whole => {
                ImageSize { height: trained.height * self.phase, width: trained.width * self.phase }
            }
            ViewsAs::Repeated => trained,
        }
    }

    /// How many views a photo becomes.
    pub fn views_of_photo(&self) -> usize {
        match self.views_as {
            ViewsAs::Polyphase | ViewsAs::Repeated => (self.phase * self.phase) as usize,
            ViewsAs::Whole => 1,
        }
    }

    /// What `photo`, which has the size that [`Input::photo_size`] tells, becomes.
    ///
    /// # Errors
    /// A photo of another size that can't be divided.
    pub fn views(&self, photo: &View) -> Result<Vec<View>> {
        match self.views_as {
            ViewsAs::Polyphase => polyphase(photo, self.phase),
            ViewsAs::Whole | ViewsAs::Repeated => {
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
        let input = Input::at(96, ViewsAs::Polyphase, trained).unwrap();
        assert_eq!((input.photo_size(trained), input.views_of_photo()), ([96, 144].into(), 9));
        let whole = Input::at(96, ViewsAs::Whole, trained).unwrap();
        assert_eq!((whole.photo_size(trained), whole.views_of_photo()), ([96, 144].into(), 1));
        let repeated = Input::at(96, ViewsAs::Repeated, trained).unwrap();
        assert_eq!((repeated.photo_size(trained), repeated.views_of_photo()), (trained, 9));
        // Once its own size there is nothing to choose.
        assert!(Input::at(32, ViewsAs::Whole, trained).unwrap().is_plain());
        for height in [0, 16, 48, 97, 12_288, u32::MAX] {
            let error = Input::at(height, ViewsAs::Polyphase, trained).unwrap_err().to_string();
            assert!(
                error.starts_with(&format!("--views-at is {height}, expected a multiple of the 32")),
                "{error}"
            );
            assert!(error.ends_with("32, 64, 96, …"), "{error}");
        }
    }

    #[test]
    fn names_are_read_and_written() {
        for views_as in [ViewsAs::Polyphase, ViewsAs::Whole, ViewsAs::Repeated] {
            assert_eq!(views_as.to_string().parse::<ViewsAs>().unwrap(), views_as);
        }
        assert!("half".parse::<ViewsAs>().is_err());
    }
}
