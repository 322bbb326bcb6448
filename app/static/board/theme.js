/** Light or dark: as the system has it, unless somebody chose. */

const NAME = 'scene-theme';

export function theme(select) {
  const apply = (value) => {
    if (value) document.documentElement.dataset.theme = value;
    else delete document.documentElement.dataset.theme;
  };
  try {
    select.value = localStorage.getItem(NAME) ?? '';
  } catch {
    // Storage may be forbidden: then the choice lasts as long as the page.
  }
  apply(select.value);
  select.addEventListener('change', () => {
    apply(select.value);
    try {
      localStorage.setItem(NAME, select.value);
    } catch {
      // As above.
    }
  });
}
