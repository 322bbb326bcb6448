/** The light or dark theme: the user's choice, else that of the system. */

const NAME = 'scene-theme';

export function theme(select) {
  const apply = (value) => {
    if (value) document.documentElement.dataset.theme = value;
    else delete document.documentElement.dataset.theme;
  };
  try {
    select.value = localStorage.getItem(NAME) ?? '';
  } catch {
    // The browser may forbid storage. The choice is then kept until the page is closed.
  }
  apply(select.value);
  select.addEventListener('change', () => {
    apply(select.value);
    try {
      localStorage.setItem(NAME, select.value);
    } catch {
      // See above.
    }
  });
}
