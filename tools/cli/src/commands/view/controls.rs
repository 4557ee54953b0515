//! Interpretation of keys, buttons and the wheel: maps input events to actions, without window
//! or camera.

use glam::Vec2;
use std::collections::BTreeSet;
use winit::event::{ElementState, MouseButton, MouseScrollDelta};
use winit::keyboard::KeyCode;

/// Pixels of a touchpad's scrolling that count as one step of a wheel.
const STEP_PX: f32 = 50.0;

/// A single action of a key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KeyAction {
    /// Toggles orbit and fly.
    Toggle,
    /// Returns to the first camera.
    Reset,
    /// Sets r of r×r children per pixel.
    Upscale(usize),
    /// Toggles the level of detail.
    Levels,
    /// Saves a picture of the window.
    Save,
    /// Prints the list of keys.
    Help,
    /// Quits.
    Quit,
}

/// Effect of a cursor movement, px, x right and y down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Drag {
    /// Turns the camera.
    Turn(Vec2),
    /// Moves the camera.
    Pan(Vec2),
}

/// A direction of movement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Step {
    Right,
    Left,
    Up,
    Down,
    Forward,
    Back,
}

/// State of keys, buttons and cursor.
#[derive(Debug, Default)]
pub struct Controls {
    held: BTreeSet<Step>,
    /// Pressed since the last [`Controls::motion`]. A key that is pressed and released between two
    /// frames moves the camera in one of them.
    tapped: BTreeSet<Step>,
    shift: bool,
    left: bool,
    right: bool,
    cursor: Option<Vec2>,
}

fn step(key: KeyCode) -> Option<Step> {
    Some(match key {
        KeyCode::KeyW => Step::Forward,
        KeyCode::KeyS => Step::Back,
        KeyCode::KeyA => Step::Left,
        KeyCode::KeyD => Step::Right,
        KeyCode::KeyQ => Step::Down,
        KeyCode::KeyE => Step::Up,
        _ => return None,
    })
}

fn key_action(key: KeyCode) -> Option<KeyAction> {
    Some(match key {
        KeyCode::KeyF => KeyAction::Toggle,
        KeyCode::KeyR => KeyAction::Reset,
        KeyCode::Digit1 | KeyCode::Numpad1 => KeyAction::Upscale(1),
        KeyCode::Digit2 | KeyCode::Numpad2 => KeyAction::Upscale(2),
        KeyCode::Digit4 | KeyCode::Numpad4 => KeyAction::Upscale(4),
        KeyCode::KeyL => KeyAction::Levels,
        KeyCode::KeyP => KeyAction::Save,
        KeyCode::KeyH => KeyAction::Help,
        KeyCode::Escape => KeyAction::Quit,
        _ => return None,
    })
}

impl Controls {
    /// Handles a key, by its position on the keyboard, so that movement uses the same fingers in
    /// every layout. `repeat` marks the system's automatic repetition.
    pub fn key(&mut self, key: KeyCode, state: ElementState, repeat: bool) -> Option<KeyAction> {
        let down = state.is_pressed();
        if let Some(step) = step(key) {
            if down {
                self.held.insert(step);
                self.tapped.insert(step);
            } else {
                self.held.remove(&step);
            }
            return None;
        }
        key_action(key).filter(|_| down && !repeat)
    }

    /// Sets whether a shift key is down.
    pub fn shift(&mut self, down: bool) {
        self.shift = down;
    }

    /// Handles a button of the mouse.
    pub fn button(&mut self, button: MouseButton, state: ElementState) {
        match button {
            MouseButton::Left => self.left = state.is_pressed(),
            MouseButton::Right => self.right = state.is_pressed(),
            _ => {}
        }
    }

    /// Handles the cursor's position, px; returns the drag, if a button is down.
    pub fn cursor(&mut self, at: Vec2) -> Option<Drag> {
        let by = at - self.cursor.replace(at)?;
        match (self.left, self.right) {
            _ if by == Vec2::ZERO => None,
            (_, true) => Some(Drag::Pan(by)),
            (true, false) if self.shift => Some(Drag::Pan(by)),
            (true, false) => Some(Drag::Turn(by)),
            (false, false) => None,
        }
    }

    /// Converts the wheel's movement to steps forward.
    pub fn wheel(delta: MouseScrollDelta) -> f32 {
        match delta {
            MouseScrollDelta::LineDelta(_, y) => y,
            MouseScrollDelta::PixelDelta(px) => px.y as f32 / STEP_PX,
        }
    }

    /// True if a movement key is down.
    pub fn moving(&self) -> bool {
        !self.held.is_empty() || !self.tapped.is_empty()
    }

    /// Movement in the next frame: towards right, up and forward, each −1 to 1, and whether it is
    /// fast.
    pub fn motion(&mut self) -> ([f32; 3], bool) {
        let tapped = std::mem::take(&mut self.tapped);
        let on = |step: Step| f32::from(self.held.contains(&step) || tapped.contains(&step));
        let axis = |plus, minus| on(plus) - on(minus);
        let along = [
            axis(Step::Right, Step::Left),
            axis(Step::Up, Step::Down),
            axis(Step::Forward, Step::Back),
        ];
        (along, self.shift)
    }

    /// Releases all keys, when the window loses the keyboard.
    pub fn release(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ElementState::{Pressed, Released};

    #[test]
    fn drags_by_button_and_shift() {
        let mut c = Controls::default();
        let px = Vec2::new(3.0, -2.0);
        assert_eq!(c.cursor(Vec2::ZERO), None);
        assert_eq!(c.cursor(px), None);
        c.button(MouseButton::Left, Pressed);
        assert_eq!(c.cursor(2.0 * px), Some(Drag::Turn(px)));
        assert_eq!(c.cursor(2.0 * px), None);
        c.shift(true);
        assert_eq!(c.cursor(3.0 * px), Some(Drag::Pan(px)));
        c.shift(false);
        c.button(MouseButton::Right, Pressed);
        assert_eq!(c.cursor(4.0 * px), Some(Drag::Pan(px)));
        c.button(MouseButton::Right, Released);
        assert_eq!(c.cursor(5.0 * px), Some(Drag::Turn(px)));
        c.release();
        assert_eq!(c.cursor(9.0 * px), None);
        assert_eq!(c.cursor(10.0 * px), None);
    }

    #[test]
    fn keys_move_while_they_are_held_and_once_when_they_were_tapped() {
        let mut c = Controls::default();
        c.key(KeyCode::KeyW, Pressed, false);
        c.key(KeyCode::KeyQ, Pressed, false);
        assert_eq!(c.motion(), ([0.0, -1.0, 1.0], false));
        c.key(KeyCode::KeyS, Pressed, false);
        c.shift(true);
        assert_eq!(c.motion(), ([0.0, -1.0, 0.0], true));
        for key in [KeyCode::KeyW, KeyCode::KeyQ, KeyCode::KeyS] {
            c.key(key, Released, false);
        }
        assert!(!c.moving());
        c.key(KeyCode::KeyA, Pressed, false);
        c.key(KeyCode::KeyA, Released, false);
        assert!(c.moving());
        assert_eq!(c.motion().0, [-1.0, 0.0, 0.0]);
        assert!(!c.moving() && c.motion().0 == [0.0; 3]);
        c.key(KeyCode::KeyE, Pressed, false);
        c.release();
        assert!(!c.moving());
    }

    #[test]
    fn actions_happen_once() {
        let mut c = Controls::default();
        assert_eq!(c.key(KeyCode::Digit4, Pressed, false), Some(KeyAction::Upscale(4)));
        assert_eq!(c.key(KeyCode::Digit4, Pressed, true), None);
        assert_eq!(c.key(KeyCode::Digit4, Released, false), None);
        assert_eq!(c.key(KeyCode::Escape, Pressed, false), Some(KeyAction::Quit));
        assert_eq!(c.key(KeyCode::KeyL, Pressed, false), Some(KeyAction::Levels));
        assert_eq!(c.key(KeyCode::KeyS, Pressed, false), None);
        assert_eq!(c.key(KeyCode::F12, Pressed, false), None);
    }

    #[test]
    fn a_touchpad_scrolls_as_a_wheel_does() {
        let px = winit::dpi::PhysicalPosition::new(0.0, -100.0);
        assert_eq!(Controls::wheel(MouseScrollDelta::PixelDelta(px)), -2.0);
        assert_eq!(Controls::wheel(MouseScrollDelta::LineDelta(5.0, 1.0)), 1.0);
    }
}
