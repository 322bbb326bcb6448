/** The menu with the actions for an object (WAI-ARIA pattern). */

/**
 * @param {HTMLElement} menu
 * @param {Element} opener gets the focus back
 * @param {{left: number, top: number}} at pixels of the page
 * @param {[string, () => void][]} items
 */
export function openMenu(menu, opener, at, items, name) {
  menu.replaceChildren(
    ...items.map(([words, act]) => {
      const item = document.createElement('li');
      item.setAttribute('role', 'menuitem');
      item.tabIndex = -1;
      item.textContent = words;
      item.addEventListener('click', () => {
        close(true);
        act();
      });
      return item;
    }),
  );
  menu.setAttribute('aria-label', name);
  menu.hidden = false;
  const { offsetWidth: width, offsetHeight: height } = menu;
  menu.style.left = `${Math.max(4, Math.min(at.left, innerWidth - width - 8)) + scrollX}px`;
  menu.style.top = `${Math.max(4, Math.min(at.top, innerHeight - height - 8)) + scrollY}px`;
  const all = [...menu.children];
  all[0].focus();

  function close(back) {
    menu.hidden = true;
    menu.onkeydown = null;
    menu.onfocusout = null;
    if (back && opener.isConnected) opener.focus();
  }
  menu.onfocusout = (event) => {
    if (!menu.contains(event.relatedTarget)) close(false);
  };
  menu.onkeydown = (event) => {
    const index = all.indexOf(document.activeElement);
    const steps = { ArrowDown: index + 1, ArrowUp: index - 1 + all.length, Home: 0, End: all.length - 1 };
    if (event.key in steps) all[steps[event.key] % all.length].focus();
    else if (event.key === 'Enter' || event.key === ' ') document.activeElement.click();
    else if (event.key === 'Escape' || event.key === 'Tab') close(true);
    else return;
    event.preventDefault();
    event.stopPropagation();
  };
}
